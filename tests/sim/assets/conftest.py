"""Every test of the object sets gets a cache folder of its own."""

import pytest

from ba_torchrl.sim.assets.cache import CACHE_VARIABLE


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"
