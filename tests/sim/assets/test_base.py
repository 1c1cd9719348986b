"""Requirements on every object set of the package."""

import numpy as np
import pytest

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.assets import hulls
from ba_torchrl.sim.assets.base import OBJECT_SETS, load_object_set


@pytest.mark.parametrize(
    ("name", "least", "stride"),
    [
        ("random", 86, 6),
        ("household", 12, 1),
        pytest.param("random", 86, 1, marks=pytest.mark.slow),
    ],
)
def test_sets_hold_named_shapes_of_one_material(name, least, stride):
    shapes = load_object_set(name)
    assert len(shapes) == len(set(shapes.names)) >= least
    for shape in shapes[::stride]:
        assert shape.mass_kg == 0.15
        assert shape.friction == 0.6
        volumes, centers = zip(*map(hulls.volume_and_center, shape.parts), strict=True)
        assert min(volumes) > 0
        center = np.average(centers, axis=0, weights=volumes)
        np.testing.assert_allclose(center, 0, atol=1e-9)
        extents = np.sort(np.ptp(shape.mesh().vertices, axis=0))
        assert 0.012 < extents[0] < 0.066  # the gripper opens to 8 cm
        assert extents[2] < 0.155


def test_shapes_are_loaded_on_access(monkeypatch):
    shapes = OBJECT_SETS["random"](None)
    loaded = []
    parts = type(shapes).parts
    monkeypatch.setattr(type(shapes), "parts", lambda self, i: loaded.append(i) or parts(self, i))
    assert shapes[-1] is shapes[85]
    assert [shapes[85]] == shapes[85:]
    assert loaded == [85]
    with pytest.raises(IndexError):
        shapes[86]


def test_worlds_share_the_shapes_of_a_packaged_set():
    assert load_object_set("random") is load_object_set("random")


def test_an_unknown_set_and_an_unused_folder_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="household"):
        load_object_set("houshold")
    for name in set(OBJECT_SETS) - {"graspnet"}:
        for root in (str(tmp_path), ""):
            with pytest.raises(ConfigError, match="asset_root"):
                load_object_set(name, root)


def test_random_shapes_stand_so_that_fingers_fit_at_yaw_zero():
    for shape in load_object_set("random")[::6]:
        low, high = shape.bounds_m
        vertices = shape.mesh().vertices
        across = vertices[np.abs(vertices[:, 1]) < hulls.FINGER_HALF_WIDTH_M]
        assert len(across) == 0 or np.ptp(across[:, 0]) <= hulls.MAX_GAP_M + 1e-3
        assert high[2] - low[2] >= 0.02 - 1e-6
