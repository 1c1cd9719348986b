"""Experts on a robot with fingers 1.5 times as wide, which these tests register."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from ba_torchrl.demonstrations.collect import expert_scores
from ba_torchrl.sim.robots import ur5
from ba_torchrl.sim.robots.base import ROBOTS, measured_gripper
from tests.tasks.episodes import slow

MODELS = Path(ur5.__file__).parent / "models"
WIDTH_M, WIDER_M = "0.019", "0.0285"
EPISODES = 10


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """Register the robot for the tests of this module, and return its name."""
    folder = tmp_path_factory.mktemp("models")
    shutil.copy(MODELS / "unit_box.obj", folder)
    model = (MODELS / "parallel_jaw.urdf").read_text()
    assert f"0.016 {WIDTH_M} 0.066" in model
    (folder / "wide_jaw.urdf").write_text(model.replace(f" {WIDTH_M} ", f" {WIDER_M} "))

    class WideJaw(ur5.UR5ParallelJaw):
        """UR5 with wide fingers."""

        gripper_model = str(folder / "wide_jaw.urdf")

    ROBOTS.register("wide_jaw")(WideJaw)
    yield "wide_jaw"
    del ROBOTS._entries["wide_jaw"]


def test_only_the_width_of_the_fingers_differs(robot):
    wide, narrow = (measured_gripper(ROBOTS[name]) for name in (robot, "ur5"))
    wider = (float(WIDER_M) - float(WIDTH_M)) / 2
    assert wide.half_width_m - narrow.half_width_m == pytest.approx(wider, abs=1e-3)
    assert wide.half_gap_m == narrow.half_gap_m
    np.testing.assert_allclose(wide.tip_arc, narrow.tip_arc, atol=1e-6)


@pytest.mark.parametrize(
    "task",
    [
        "open_loop/block_stacking",
        "close_loop/block_stacking",
        *slow(["open_loop/bin_packing", "close_loop/drawer_opening"]),
    ],
)
def test_experts_succeed_with_wide_fingers(robot, task):
    scores = expert_scores(task, EPISODES, seed=0, num_envs=1, parallel=False, robot=robot)
    assert scores.success_rate == 1
