"""What users see of the package: names and help."""

import pydoc

import pytest

import ba_torchrl
from ba_torchrl import data, envs, modules, objectives
from ba_torchrl.core.errors import install_command


def test_the_help_of_the_package_shows_its_functions():
    text = pydoc.plain(pydoc.render_doc(ba_torchrl))
    for name in ("make", "make_vector_env", "list_tasks", "list_robots", "describe", "load_policy"):
        assert f"    {name}(" in text
        assert getattr(ba_torchrl, name).__doc__.strip().splitlines()[0] in text


@pytest.mark.parametrize("package", [ba_torchrl, data, envs, modules, objectives])
def test_every_public_name_is_described(package):
    for name in set(package.__all__) - {"__version__", "NETWORKS"}:
        assert (getattr(package, name).__doc__ or "").strip(), name
        assert name in dir(package)


def test_the_command_that_installs_a_package_has_its_bounds(monkeypatch):
    monkeypatch.setattr(
        "ba_torchrl.core.errors.requires", lambda _: ['hydra-core<1.4,>=1.3.2; extra == "train"']
    )
    found = install_command("hydra-core", "other")
    assert found == "pip install 'hydra-core<1.4,>=1.3.2' other"
