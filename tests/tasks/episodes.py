"""The tasks of the tests, and the episodes that they play."""

import contextlib

import pytest
import torch

import ba_torchrl
from ba_torchrl.demonstrations.collect import collect_demonstrations

SLOW_VARIANTS = [f"ramp/house_building_{i}" for i in (1, 2, 3, 4)]
SLOW_VARIANTS += ["ramp/block_stacking", "ramp/improvise_house_building_2"]
"""Tasks of `six_dof.VARIANTS` that only slow tests play: three rows represent the others."""


def slow(values):
    """Return the values of a parameter of slow tests."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def slow_variants(tasks):
    """Return tasks, of which `SLOW_VARIANTS` are for the slow tests."""
    return [pytest.param(t, marks=[pytest.mark.slow] * (t in SLOW_VARIANTS)) for t in tasks]


def follow(env, state, steps=1000, action=None):
    """Take expert actions, or the given one, until the episode ends; return every state."""
    seen = []
    for _ in range(steps):
        chosen = state["expert_action"] if action is None else action
        state = env.step(state.clone().set("action", chosen))["next"]
        seen.append(state)
        if state["done"]:
            break
    return seen


def follow_expert(env, state):
    """Take one expert action; return the next state."""
    return follow(env, state, steps=1)[0]


def play(env, state, action=None):
    """Act until the episode ends; return the last state."""
    return follow(env, state, action=action)[-1]


def check_lift(env, position, low_m=0.145, high_m=0.155):
    """Check that success requires a grasp of the body at a position and a height of 15 cm."""
    scene = env.scene
    scene.controller.reset(((*position[:2], high_m), 0.0))
    assert not scene.task.is_success()  # high, without the body
    scene.controller.move_to(position, 0.0)
    scene.controller.grip(0.0)
    scene.controller.move_to((*position[:2], low_m), 0.0)
    assert not scene.task.is_success()  # held, at a low height
    scene.controller.move_to((*position[:2], high_m), 0.0)
    assert scene.task.is_success()
    scene.controller.grip(1.0)
    scene.world.settle()
    assert not scene.task.is_success()


def play_scene(env):
    """Take expert actions from the present scene, at rest; return the last step."""
    env.scene.world.settle()
    env.scene.world.step(2)
    while True:
        action = torch.from_numpy(env._expert_action(env.scene))
        state = env._step(env.full_action_spec.zero().set("action", action))
        if state["done"]:
            return state


def demonstrations(task, count, *, num_envs=1, env=(), **options):
    """Return demonstrations in environments of this process with given parameters."""
    settings = {"seed": 0, "parallel": False, "expert": True, **dict(env)}
    with contextlib.closing(ba_torchrl.make_vector_env(task, num_envs, **settings)) as envs:
        return collect_demonstrations(envs, count, **{"seed": 0, **options})
