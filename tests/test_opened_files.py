"""Files that recipes open besides runs and demonstrations (tests/training/test_durable.py)."""

import pickle
import sys

import numpy as np
import pytest

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.results import read_failure
from ba_torchrl.sim.assets.cache import CACHE_VARIABLE, Decomposition, cached_parts
from ba_torchrl.sim.assets.graspnet import read_mesh
from ba_torchrl.sim.meshes import rod_mesh
from profiling.fingerprint.compare import read_record
from profiling.speed_file import read_speed_file
from recipes.soak import SoakJob, run_soak
from tests.planted import Planted

REACHING = "close_loop/block_reaching"


@pytest.fixture
def plant(tmp_path):
    """Write pickles; after the test, check that none of them was unpickled."""
    trace = tmp_path / "trace"

    def write(path):
        path.write_bytes(pickle.dumps(Planted(trace)))
        return path

    yield write
    assert not trace.exists()
    pickle.loads(pickle.dumps(Planted(trace)))
    assert trace.exists()


@pytest.mark.parametrize(
    ("name", "read"),
    [("speed.json", read_speed_file), ("record.json", read_record), ("mesh.obj", read_mesh)],
)
def test_a_file_that_is_named_is_refused(name, read, plant, tmp_path):
    path = plant(tmp_path / name)
    with pytest.raises(ConfigError, match=name):
        read(path)


def test_a_record_of_a_failure_is_reported_as_damaged(plant, tmp_path):
    plant(tmp_path / "failure.json")
    assert read_failure(tmp_path) == "failure.json is damaged"


def test_damaged_figures_of_a_soak_are_measured_again(plant, tmp_path):
    plant(tmp_path / f"{REACHING.replace('/', '-')}.json")
    measured = sys.executable, "-c", "raise SystemExit('measured')"
    failures = run_soak(
        [SoakJob(task=REACHING, steps=10)], tmp_path, progress=False, worker=measured
    )
    assert "measured" in failures[REACHING]


def test_a_damaged_cache_of_parts_is_computed_again(plant, tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    mesh = rod_mesh(0.1, 0.02)
    cached_parts(b"content", "recipe", lambda: Decomposition((mesh,)))
    (file,) = (tmp_path / "cache").rglob("*.npz")
    for damage in (plant, _plant_object(tmp_path / "trace")):
        damage(file)
        (part,) = cached_parts(b"content", "recipe", lambda: Decomposition((mesh,))).parts
        assert np.array_equal(part.vertices, mesh.vertices)


def _plant_object(trace):
    """Return a function that writes an archive of arrays one of which holds an object."""

    def write(path):
        array = np.empty(1, dtype=object)
        array[0] = Planted(trace)
        np.savez(path, vertices=array, faces=array, vertex_ends=array, face_ends=array)

    return write
