"""States, seeds and the vector observation."""

import pytest
import torch

from tests.tasks.open_loop.covid_test.scenes import follow, lay, poses, step, wait


def advance(env, state, count):
    """Take expert actions from a state on; return every state."""
    states = [state]
    for _ in range(count):
        states.append(step(env, states[-1]["expert_action"]))
    return states[1:]


def test_a_state_restores_the_task_the_hidden_swabs_and_later_steps(make):
    env = make(seed=4)
    state = follow(env, 3)  # a tube is presented, a swab held
    task, motion = env.scene.task, env.scene.controller
    swab = motion.held
    assert swab in task.swabs
    kept = env.get_state()
    first = advance(env, state, 3)
    assert swab.is_hidden
    assert task.get_state().used_swabs == (task.swabs.index(swab),)
    later = env.get_state()
    there = poses(env), task.get_state()
    env.set_state(kept)
    assert motion.held is swab
    assert swab.is_hidden
    assert task.get_state().used_swabs == ()
    assert swab in task.objects
    env.set_state(later)  # while the swab is held
    assert motion.held is not swab
    assert swab.is_hidden
    assert swab not in task.objects
    assert (poses(env), task.get_state()) == there
    for before in (kept, later):  # restored from before the test and from after it
        env.set_state(before)
        second = advance(env, env.set_state(kept), 3)
        for one, other in zip(first, second, strict=True):
            torch.testing.assert_close(one["pixels"], other["pixels"], atol=1e-3, rtol=0)
        assert task.get_state() == there[1]
        where = [body.position for body in task.objects]
        assert where == [
            pytest.approx(pose[0], abs=1e-3)
            for body, pose in zip(env.scene.world.bodies, there[0], strict=True)
            if body in task.objects
        ]
    env.reset()
    assert not any(body.is_hidden for body in env.scene.world.bodies)
    returned = env.set_state(later)
    assert torch.equal(returned["pixels"], first[-1]["pixels"])
    assert swab.is_hidden


def test_a_failure_is_part_of_the_state(make):
    env = make()
    task = env.scene.task
    kept = env.get_state()
    for body, y in zip(task.tubes, (0.06, -0.06), strict=False):
        lay(task, body, task.layout.test_area, (0.0, y))
    wait(env)
    failed = env.get_state()
    env.set_state(kept)
    assert not task.has_failed
    assert not wait(env)["done"]
    assert env.set_state(failed)["terminated"]
    assert task.has_failed
    env.reset()
    assert not task.has_failed


def test_the_same_seed_has_the_same_episode(make):
    first, second = make(seed=7), make(seed=7)
    while True:
        a, b = (follow(env, 1) for env in (first, second))
        assert torch.equal(a["pixels"], b["pixels"])
        assert poses(first) == poses(second)
        if a["done"]:
            break
    assert a["success"]


def test_the_vector_observation_keeps_entries_for_hidden_swabs(make):
    env = make(obs_type="vec")
    before = follow(env, 3)["observation"]
    after = follow(env, 1)["observation"]  # the first swab is removed
    assert before.shape == after.shape == (1 + 4 * (1 + 3 + 6),)
    swabs = after[-12:].reshape(3, 4)
    assert (swabs == torch.tensor([1.0, 1.0, 1.0, 0.0])).all(dim=1).sum() == 1
    assert after[5:].abs().max() <= 1.2
