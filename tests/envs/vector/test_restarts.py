"""Starting workers overlaps the work of the others; failures in a row end it at the limit."""

import logging
import multiprocessing
import time
from functools import partial

import pytest
import torch
from fake_env import FakeEnv, act, assert_lost, assert_stepped, kill

from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.core.errors import WorkerError
from ba_torchrl.envs.vector import parallel
from ba_torchrl.envs.vector.parallel import VectorEnv

METHODS = pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])


def step_until(env, state, condition, seconds=120.0):
    """Step until a condition on a step holds; return that step and the state after it."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        step, state = env.step_and_maybe_reset(act(env, state))
        if condition(step):
            return step, state
    raise AssertionError(f"not within {seconds} s")


def test_other_workers_step_before_a_start_is_awaited(make_fakes, monkeypatch):
    env = make_fakes(2)
    state = env.reset()
    kill(env.worker_pids[0])
    order, receive = [], parallel.Worker.receive
    monkeypatch.setattr(
        parallel.Worker,
        "receive",
        lambda worker: (order.append(worker.process.pid), receive(worker))[1],
    )
    result = env.step(act(env, state.clone()))
    new, other = env.worker_pids
    assert order[:2] == [other, new]
    assert_lost(result, 0, state)
    assert_stepped(result, 1, state)


@pytest.mark.parametrize("how", ["idle", "in a step"])
def test_environments_are_absent_while_their_worker_starts(make_fakes, tmp_path, how):
    env = make_fakes(2, folder=tmp_path, wait_for_restarts=False)
    state = env.reset()
    (tmp_path / "build").write_text("wait")
    if how == "idle":
        kill(env.worker_pids[0])
    else:
        (tmp_path / f"{env.worker_pids[0]}.step").write_text("kill")
    before = state.clone()
    for count in range(1, 6):
        step, state = env.step_and_maybe_reset(act(env, state))
        assert_lost(step, 0, before)
        assert state["fault"].flatten().tolist() == [True, False]
        assert not state["done"].any()
        assert state["step_count"][1].item() == count
        # the first fault is the loss of an episode, the others are of an absent environment
        assert step["fault"].flatten().tolist() == [count > 1, False]
    with pytest.raises(WorkerError, match=r"the episodes of environments \[0\] are lost"):
        env.get_positions()
    (tmp_path / "build").unlink()
    step, state = step_until(env, state, lambda step: not step["fault"].any())
    assert not step["next", "fault"].any()
    assert step["next", "step_count"][0].item() == 1
    assert step["next", "step_count"][1].item() > 6
    assert env.restarts == 1


def test_a_full_reset_waits_for_workers_that_start(make_fakes, tmp_path):
    env = make_fakes(2, wait_for_restarts=False)
    expected = env.reset(seed=8)["depth"]
    kill(env.worker_pids[1])
    state = env.reset(seed=8)
    assert torch.equal(state["depth"], expected)
    assert not state["fault"].any()
    assert env.restarts == 1


def test_steps_go_on_when_every_worker_has_ended(make_fakes):
    env = make_fakes(2, wait_for_restarts=False)
    state = env.reset()
    kill(env.worker_pids[0])
    kill(env.worker_pids[1])
    step, state = env.step_and_maybe_reset(act(env, state))
    assert step["next", "fault"].all()
    step, _ = step_until(env, state, lambda step: not step["fault"].any())
    assert step["next", "step_count"].min() == 1  # the last one to start


def test_workers_that_start_end_with_the_environments(make_fakes, tmp_path):
    env = make_fakes(2, folder=tmp_path, wait_for_restarts=False)
    state = env.reset()
    (tmp_path / "build").write_text("wait")
    kill(env.worker_pids[0])
    env.step_and_maybe_reset(act(env, state))
    env.close()
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("waits", [True, False])
def test_deaths_at_the_start_of_a_restart_end_at_the_limit(make_fakes, tmp_path, waits):
    env = make_fakes(2, folder=tmp_path, max_restarts=5, wait_for_restarts=waits)
    state = env.reset()
    (tmp_path / "build").write_text("kill")
    kill(env.worker_pids[0])
    with pytest.raises(RuntimeError, match=r"worker 0 failed 6 times without starting.*SIGKILL"):
        step_until(env, state, lambda step: False)
    assert env.is_closed
    assert env.restarts == 6
    assert multiprocessing.active_children() == []


def test_a_restart_that_succeeds_resets_the_count(make_fakes, tmp_path, caplog, monkeypatch):
    env = make_fakes(1, folder=tmp_path, max_restarts=2)
    state = env.reset()
    attempts = []

    class FailsTwice(parallel.Worker):
        def __init__(self, *args):
            attempts.append(self)
            is_fatal, build = len(attempts) % 3, tmp_path / "build"
            build.write_text("kill") if is_fatal else build.unlink()
            super().__init__(*args)
            if is_fatal:
                self.process.join(60)

    monkeypatch.setattr(parallel, "Worker", FailsTwice)
    for _ in range(2):
        kill(env.worker_pids[0])
        with caplog.at_level(logging.CRITICAL):
            step, state = env.step_and_maybe_reset(act(env, state))
        assert step["next", "fault"].all()
    assert len(attempts) == env.restarts == 6


@METHODS
def test_deaths_at_the_first_start_are_retried_up_to_the_limit(tmp_path, method):
    factory = partial(FakeEnv, folder=tmp_path)
    env = VectorEnv(2, factory, workers=WorkerOptions(start_method=method, max_restarts=1))
    (tmp_path / "build").write_text("kill")
    with pytest.raises(RuntimeError, match=r"failed 2 times without starting.*SIGKILL"):
        env.start()
    assert env.restarts == 2  # each worker once
    assert multiprocessing.active_children() == []
    (tmp_path / "build").unlink()
    state = env.reset()
    assert_stepped(env.step(act(env, state.clone())), 0, state)
    env.close()


@METHODS
def test_deaths_in_mid_step_end_at_the_limit(make_fakes, tmp_path, method):
    env = make_fakes(2, folder=tmp_path, start_method=method, max_restarts=1)
    state = env.reset()
    (tmp_path / "all.step").write_text("always kill")
    _, state = env.step_and_maybe_reset(act(env, state))
    with pytest.raises(RuntimeError, match=r"worker \d failed 2 times without completing a step"):
        env.step_and_maybe_reset(act(env, state))
    assert env.is_closed
