"""Random layouts of objects around a container."""

import itertools

import numpy as np
import pytest

from ba_torchrl.errors import PlacementError
from ba_torchrl.tasks.manipulation.footprints import Rectangle, gap_m
from ba_torchrl.tasks.packing.layout import Footprint, scatter
from tests.tasks.packing.scenes import BIN


def test_scattered_objects_keep_clearance(make_env):
    env = make_env(BIN)
    env.reset()
    task = env.scene.task
    fixed = Rectangle(0.45, 0.0, 0.4, 0.08, 0.07)
    footprints = [Footprint(0.02, 0.04, 0.06, 0.016)] * 6
    for seed in range(5):
        places = scatter(task, np.random.default_rng(seed), footprints, [fixed])
        bodies = [Rectangle(*xy, yaw, 0.02, 0.04) for xy, yaw in places]
        for a, b in itertools.combinations([fixed, *bodies], 2):
            assert gap_m(a, b) >= 0.005
        for a, b in itertools.permutations(bodies, 2):  # every object can be grasped
            assert gap_m(a.resized(0.06, 0.016), b) >= 0
    with pytest.raises(PlacementError, match="no room for 60"):
        scatter(task, np.random.default_rng(0), footprints * 10)
