"""Scales of the objects: experts succeed at the limits of every task; others are refused."""

import numpy as np
import pytest

import ba_torchrl
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.settings import check_scales
from ba_torchrl.tasks.base import TASKS
from tests.specs import slow_except

FIXED = {"action_sequence": "pxyz", "random_orientation": False}
BEYOND = 0.02
FAST = ("close_loop/block_in_bowl", "open_loop/house_building_3", "bump/box_palletizing")
SCALED = [task for task in ba_torchrl.list_tasks() if np.ptp(TASKS[task].scale_limits) > 0]


def steps_to_success(task, episodes, **config):
    """Return the expert's number of steps in each episode, None for a failure."""
    size = 16 if TASKS[task].control == "close_loop" else 128
    env = ba_torchrl.make(task, seed=0, expert=True, obs_size=size, **config)
    steps = []
    for _ in range(episodes):
        episode = env.rollout(env.max_steps, lambda td: td.set("action", td["expert_action"]))
        steps.append(len(episode) if episode["next", "success"][-1] else None)
    env.close()
    return steps


@pytest.mark.parametrize("config", [{}, pytest.param(FIXED, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("task", "mean_steps"), [("close_loop/block_pushing", 9), ("close_loop/corner_picking", 18)]
)
def test_experts_push_and_drag_small_blocks(task, mean_steps, config):
    steps = steps_to_success(task, 20, object_scale_range=0.6, **config)
    solved = [count for count in steps if count is not None]
    assert len(solved) >= 19
    assert np.mean(solved) < mean_steps


@pytest.mark.parametrize("end", [0, 1], ids=["smallest", "largest"])
@pytest.mark.parametrize("task", slow_except(SCALED, FAST))
def test_experts_solve_tasks_at_both_limits(task, end):
    scale = TASKS[task].scale_limits[end]
    assert None not in steps_to_success(task, 2, object_scale_range=scale)


@pytest.mark.parametrize("task", ba_torchrl.list_tasks())
def test_scales_outside_the_limits_are_refused_with_the_allowed_range(task):
    check_scales(task, TASKS[task].scale_range)
    low, high = TASKS[task].scale_limits
    allowed = f"{low:g} to {high:g}" if low < high else f"{low:g} only"
    for scales in (low - BEYOND, high + BEYOND, (low - BEYOND, high), (low, high + BEYOND)):
        with pytest.raises(ConfigError, match=f"{task}.*object_scale_range.*{allowed}"):
            ba_torchrl.make(task, object_scale_range=scales)


def test_scales_may_exceed_the_limits_by_rounding_errors():
    low, high = TASKS["close_loop/block_stacking"].scale_limits
    check_scales("close_loop/block_stacking", (low - 1e-12, high + 1e-12))


def test_the_walls_of_the_corner_scale_with_the_block():
    heights = []
    for scale in (0.6, 1.0):
        env = ba_torchrl.make("close_loop/corner_picking", seed=0, object_scale_range=scale)
        env.reset()
        task = env.scene.task
        heights.append((task.walls.shape.height_m, task.block.shape.height_m))
        env.close()
    np.testing.assert_allclose(heights, [(0.048, 0.03), (0.08, 0.05)], atol=1e-6)
