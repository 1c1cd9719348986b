"""Actions whose pose is out of reach, as told by the environment and by Gymnasium's info."""

import math

import gymnasium
import numpy as np
import pytest
import torch

from ba_torchrl.core import keys

HORIZONTAL = [0.0, 0.45, 0.0, 0.02, 0.0, 0.0, math.pi / 2]
VERTICAL = [0.0, 0.45, 0.0, 0.02, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("fast_mode", [True, False])
def test_a_pick_through_the_floor_has_no_effect_and_is_told(make, fast_mode):
    with_tilt = {"action_sequence": "pxyzrrr", "fast_mode": fast_mode}
    env = make("open_loop/block_stacking", seed=0, obs_size=32, **with_tilt)
    state = env.reset()
    assert env.is_out_of_reach is False
    after = env.step(state.clone().set(keys.ACTION, torch.tensor(HORIZONTAL)))[keys.NEXT]
    assert env.is_out_of_reach
    torch.testing.assert_close(after[keys.HEIGHTMAP], state[keys.HEIGHTMAP], atol=1e-4, rtol=0)
    saved = env.get_state()
    env.step(state.clone().set(keys.ACTION, torch.tensor(VERTICAL)))
    assert not env.is_out_of_reach
    env.reset(saved, set_state=True)
    assert env.is_out_of_reach
    env.reset()
    assert not env.is_out_of_reach


def test_gymnasium_info_tells_what_is_out_of_reach():
    env = gymnasium.make(
        "ba_torchrl:BulletArm/OpenLoopBlockStacking-v0", obs_size=32, action_sequence="pxyzrrr"
    )
    _, info = env.reset(seed=0)
    assert not info["is_out_of_reach"]
    *_, info = env.step(np.array(HORIZONTAL, dtype=np.float32))
    assert info["is_out_of_reach"]
    for primitive in (0.0, 1.0):  # a place without an object is ignored
        *_, info = env.step(np.array([primitive, *VERTICAL[1:]], dtype=np.float32))
        assert not info["is_out_of_reach"]
        env.step(np.array(HORIZONTAL, dtype=np.float32))
    env.close()


def test_a_close_loop_motion_that_leaves_the_reach_is_told(make):
    env = make("close_loop/block_reaching", seed=0, obs_size=32)
    state = env.reset()
    solve = env.scene.robot.inverse_kinematics
    assert not env.is_out_of_reach
    limit = env.scene.robot.tool_pose()[0][0] + 0.01
    env.scene.robot.inverse_kinematics = lambda p, *rest: None if p[0] > limit else solve(p, *rest)
    env.step(state.clone().set(keys.ACTION, torch.tensor([1.0, 1.0, 0.0, 0.0, 0.0])))
    assert env.is_out_of_reach
    assert env.scene.robot.tool_pose()[0][0] < limit + 1e-3
    env.step(state.clone().set(keys.ACTION, torch.tensor([1.0, -1.0, 0.0, 0.0, 0.0])))
    assert not env.is_out_of_reach
