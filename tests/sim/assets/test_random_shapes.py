"""The random shapes: the criterion of their choice, and their pose."""

import numpy as np
import pytest

from ba_torchrl.sim.assets import hulls, random_shapes
from ba_torchrl.sim.assets.base import load_object_set


def test_chosen_random_shapes_have_the_recorded_scale():
    for number, scale in random_shapes.CHOICE[::8]:
        found = random_shapes.examine(number)
        assert found is not None
        assert found.scale == scale


def test_unsuitable_random_shapes_are_refused(monkeypatch):
    assert random_shapes.examine(168) is None  # its file contains NaN
    number, _ = random_shapes.CHOICE[0]
    for limit, value in (("LONGEST_M", 0.01), ("FLATTEST_M", 0.2), ("LEAST_FILL", 1.01)):
        with monkeypatch.context() as patch:
            patch.setattr(random_shapes, limit, value)
            assert random_shapes.examine(number) is None


@pytest.mark.slow
def test_the_choice_of_random_shapes_follows_from_the_criterion():
    assert random_shapes.choose() == random_shapes.CHOICE


def test_random_shapes_stand_so_that_fingers_fit_at_yaw_zero():
    for shape in load_object_set("random"):
        low, high = shape.bounds_m
        vertices = shape.mesh().vertices
        across = vertices[np.abs(vertices[:, 1]) < hulls.FINGER_HALF_M]
        assert len(across) == 0 or np.ptp(across[:, 0]) <= hulls.GAP_M + 1e-3
        assert high[2] - low[2] >= random_shapes.FLATTEST_M - 1e-6
