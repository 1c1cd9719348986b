"""The named conditions of success, their conjunction, and their entries in Gymnasium's info."""

import numpy as np
import pybullet
import pytest
import torch

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.tasks.close_loop.block_picking import BlockPicking
from tests.specs import slow_except


@pytest.mark.parametrize(
    "task",
    slow_except(
        ba_torchrl.list_tasks(),
        ["close_loop/block_stacking", "open_loop/covid_test", "bump/box_palletizing"],
    ),
)
def test_success_is_the_conjunction_of_the_conditions(make, task):
    env = make(task, seed=3, obs_size=32, expert=True)
    state = env.reset()
    names = env.conditions.keys()
    assert not all(env.conditions.values())
    seen = []
    for _ in range(env.max_steps):
        state = env.step(state.set(keys.ACTION, state[keys.EXPERT_ACTION].clone()))[keys.NEXT]
        conditions = env.conditions
        assert all(
            name.startswith("is_") and type(holds) is bool for name, holds in conditions.items()
        )
        assert conditions.keys() == names
        assert bool(state[keys.SUCCESS]) == (env.scene.task.is_valid() and all(conditions.values()))
        seen.append(tuple(conditions.values()))
        if state[keys.DONE]:
            break
    assert bool(state[keys.SUCCESS])
    assert all(seen[-1])
    state = env.reset()
    pybullet.disconnect(physicsClientId=env.scene.world.client)
    assert env.step(state.set(keys.ACTION, env.action_spec.zero()))[keys.NEXT][keys.FAULT]
    assert env.conditions == dict.fromkeys(names, False)


def test_grasping_and_lifting_are_separate_conditions(make):
    env = make("close_loop/block_picking", seed=0, obs_size=32, expert=True)
    state, seen = env.reset(), []
    while not state[keys.DONE]:
        state = env.step(state.set(keys.ACTION, state[keys.EXPERT_ACTION].clone()))[keys.NEXT]
        seen.append(env.conditions)
    assert {"is_grasped": True, "is_lifted": False} in seen
    assert seen[-1] == {"is_grasped": True, "is_lifted": True}


def test_conditions_are_those_of_a_restored_state(make):
    env = make("close_loop/block_picking", seed=0, obs_size=32)
    env.reset()
    before, state = env.conditions, env.get_state()
    env.step(env.reset().set(keys.ACTION, torch.zeros(5)))
    env.reset(state, set_state=True)
    assert env.conditions == before


@pytest.mark.parametrize(
    ("conditions", "message"),
    [
        *((wrong, " must return bools") for wrong in ({}, {"grasped": True}, {"is_success": True})),
        (True, " must return bools"),
        *(
            ({"is_grasped": value}, ": is_grasped must be one bool, not ")
            for value in (1, None, 0.01, "yes", np.array([True, False]), torch.ones(()))
        ),
    ],
)
def test_ill_formed_conditions_are_refused(make, monkeypatch, conditions, message):
    monkeypatch.setattr(BlockPicking, "evaluate", lambda task: conditions)
    with pytest.raises(TypeError, match=rf"BlockPicking.evaluate{message}"):
        make("close_loop/block_picking", obs_size=32)


@pytest.mark.parametrize(
    "kind", [np.bool_, np.array, torch.tensor, lambda value: torch.tensor([value])]
)
def test_conditions_are_bools_of_any_library(make, monkeypatch, kind):
    env = make("close_loop/block_picking", obs_size=16, seed=0)
    state = env.reset()
    conditions = {"is_near": kind(True), "is_far": kind(False)}
    monkeypatch.setattr(BlockPicking, "evaluate", lambda _: conditions)
    assert not env.step(state.set(keys.ACTION, env.action_spec.zero()))[keys.NEXT][keys.SUCCESS]
    assert env.conditions == {"is_near": True, "is_far": False}
    assert all(type(holds) is bool for holds in env.conditions.values())
