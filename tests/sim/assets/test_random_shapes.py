"""The random shapes: the criterion of their choice, and their pose."""

import numpy as np
import pytest

from ba_torchrl.sim.assets import hulls, random_shapes
from ba_torchrl.sim.assets.base import load_object_set


def test_chosen_random_shapes_have_the_recorded_scale():
    for number, scale in random_shapes.SELECTION[::8]:
        found = random_shapes.scaled_candidate(number)
        assert found is not None
        assert found.scale == scale


def test_unsuitable_random_shapes_are_refused(monkeypatch):
    assert random_shapes.scaled_candidate(168) is None  # its file contains NaN
    number, _ = random_shapes.SELECTION[0]
    for limit, value in (("MAX_LENGTH_M", 0.01), ("MIN_HEIGHT_M", 0.2), ("MIN_FILL", 1.01)):
        with monkeypatch.context() as patch:
            patch.setattr(random_shapes, limit, value)
            assert random_shapes.scaled_candidate(number) is None


@pytest.mark.slow
def test_the_choice_of_random_shapes_follows_from_the_criterion():
    assert random_shapes.select_shapes() == random_shapes.SELECTION


def test_random_shapes_stand_so_that_fingers_fit_at_yaw_zero():
    for shape in load_object_set("random"):
        low, high = shape.bounds_m
        vertices = shape.mesh().vertices
        across = vertices[np.abs(vertices[:, 1]) < hulls.FINGER_HALF_WIDTH_M]
        assert len(across) == 0 or np.ptp(across[:, 0]) <= hulls.MAX_GAP_M + 1e-3
        assert high[2] - low[2] >= random_shapes.MIN_HEIGHT_M - 1e-6
