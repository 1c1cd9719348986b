"""Continuing from the position of another environment gives the same bits."""

import copy
import pickle

import pytest
import torch

import ba_torchrl
from ba_torchrl.core.errors import SimulationError

CASES = {
    "close_loop/block_picking": {"obs_size": 32},
    "close_loop/drawer_opening": {"obs_size": 32},
    "open_loop/house_building_2": {"obs_size": 32},
    "open_loop/object_grasping": {"obs_size": 32, "num_objects": 4},
    "open_loop/bin_packing": {"obs_size": 32, "num_objects": 3},
    "ramp/block_stacking": {"obs_size": 32},
}


def vector(task, seed, **changes):
    options = {"parallel": False, "expert": True, **CASES[task], **changes}
    return ba_torchrl.make_vector_env(task, 2, seed=seed, **options)


def play(env, state, steps, generator):
    """Step with random actions that differ little from the expert's; return all entries."""
    steps_taken = []
    for _ in range(steps):
        state["action"] = state["expert_action"].clone()
        if torch.rand((), generator=generator) < 0.3:
            low, high = env.action_spec.space.low, env.action_spec.space.high
            noise = torch.rand(state["action"].shape, generator=generator)
            state["action"] = torch.minimum(torch.maximum(low + noise * (high - low), low), high)
        step, state = env.step_and_maybe_reset(state)
        steps_taken.append(step.clone())
    return torch.stack(steps_taken) if steps_taken else None, state


def test_a_position_without_a_heap_is_the_current_episode():
    env = vector("open_loop/bin_packing", 0)
    _, state = play(env, env.reset(), 12, torch.Generator().manual_seed(0))
    for position, count in zip(env.get_positions(), state["step_count"], strict=True):
        assert position["episode"] > 0
        assert [len(actions) for actions in position["actions"]] == [count]
    env.close()


def assert_equal(one, two):
    assert set(one.keys(True, True)) == set(two.keys(True, True))
    for key in one.keys(True, True):
        assert torch.equal(one[key], two[key]), key


@pytest.mark.parametrize(
    ("task", "before"),
    [
        ("close_loop/block_picking", 0),
        *((task, 11) for task in list(CASES)[1:4]),
        *(pytest.param(task, 11, marks=pytest.mark.slow) for task in list(CASES)[4:]),
    ],
)
def test_an_environment_continues_where_another_one_stood(task, before):
    generator = torch.Generator().manual_seed(3)
    first = vector(task, seed=5)
    _, state = play(first, first.reset(), before, generator)
    positions = pickle.loads(pickle.dumps(first.get_positions()))
    following = generator.get_state()
    expected, _ = play(first, copy.deepcopy(state), 8, generator)
    first.close()

    second = vector(task, seed=77)
    second.reset()
    second.continue_from(positions)
    resumed = second.reset()
    assert_equal(resumed, state.select(*resumed.keys(True, True)))
    generator.set_state(following)
    actual, _ = play(second, resumed, 8, generator)
    assert_equal(actual, expected)
    second.close()


def test_positions_pass_between_worker_processes_and_this_one():
    task, use = "close_loop/block_picking", {"parallel": True, "start_method": "fork"}
    generator = torch.Generator().manual_seed(3)
    workers = vector(task, seed=5, **use)
    _, state = play(workers, workers.reset(), 9, generator)
    positions = workers.get_positions()
    following = generator.get_state()
    expected, _ = play(workers, state.clone(), 5, generator)
    for options in ({}, use):
        other = vector(task, seed=1, **options)
        other.continue_from(positions)
        generator.set_state(following)
        actual, _ = play(other, other.reset(), 5, generator)
        assert_equal(actual, expected)
        other.close()
    workers.close()


def test_reading_the_position_changes_nothing():
    runs = []
    for reads in (False, True):
        env = vector("close_loop/block_picking", seed=2)
        state, steps = env.reset(), []
        for _ in range(12):
            state["action"] = state["expert_action"].clone()
            step, state = env.step_and_maybe_reset(state)
            if reads:
                env.get_positions()
            steps.append(step.clone())
        env.close()
        runs.append(torch.stack(steps))
    assert_equal(*runs)


def test_a_position_that_the_actions_do_not_determine_is_refused(make):
    env = make("close_loop/block_reaching", seed=0, obs_size=16)
    env.reset()
    env.rand_step()
    state = env.get_state()

    def set_state():
        env.reset(state, set_state=True)

    for act in (env.get_state, set_state, lambda: env.set_seed(5)):
        env.reset()
        assert len(env.get_position()["actions"][0]) == 0
        act()
        with pytest.raises(SimulationError, match="do not determine"):
            env.get_position()
        other = copy.deepcopy(env)
        assert_equal(
            *(each.step(state.clone().set("action", torch.ones(5))) for each in (env, other))
        )
        assert_equal(env.reset(), other.reset())
        other.close()


def test_an_environment_that_was_not_reset_has_the_position_of_its_first_episode(make):
    first, second = (make("close_loop/block_reaching", seed=seed, obs_size=16) for seed in (0, 1))
    second.continue_from(first.get_position())
    assert_equal(second.reset(), first.reset())


def test_a_seed_takes_precedence_over_a_position(make):
    env = make("close_loop/block_reaching", seed=0, obs_size=16)
    expected = env.reset(seed=4)
    env.rand_step()
    env.continue_from(env.get_position())
    assert_equal(env.reset(seed=4), expected)
