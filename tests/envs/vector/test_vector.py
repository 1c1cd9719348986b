import gc
import multiprocessing
import os
import signal
from functools import partial
from typing import ClassVar

import pytest
import torch
from fake_env import FakeEnv, act, assert_lost, assert_stepped
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv, check_env_specs

import ba_torchrl
from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.envs.vector.batching import SerialVectorEnv
from ba_torchrl.envs.vector.make import available_cores, make_vector
from ba_torchrl.envs.vector.parallel import VectorEnv

FORK = WorkerOptions(start_method="fork")
SMALL = {"start_method": "fork", "obs_size": 16, "seed": 0}


class TestSeeds:
    def images(self, env, **kwargs):
        first = env.reset(**kwargs)["depth"]
        rollout = env.rollout(3, auto_reset=True, break_when_any_done=False)
        return torch.cat([first[:, None], rollout["depth"]], 1)

    def test_serial_and_parallel_agree(self, make_fakes):
        serial = make_fakes(3, seed=5, parallel=False)
        parallel = make_fakes(3, seed=5)
        expected = self.images(serial)
        assert torch.equal(self.images(parallel), expected)
        assert len(expected[:, 0].unique(dim=0)) == 3
        assert torch.equal(self.images(serial, seed=40), self.images(parallel, seed=40))

    @pytest.mark.parametrize("parallel", [False, True])
    @pytest.mark.parametrize("static", [False, True])
    def test_are_set_as_by_torchrl(self, make_fakes, parallel, static):
        env = make_fakes(3, parallel=parallel)
        reference = SerialEnv(3, FakeEnv)
        assert env.set_seed(8, static) == reference.set_seed(8, static_seed=static)
        images = env.reset()["depth"]
        assert torch.equal(images, reference.reset()["depth"])
        assert len(images.unique(dim=0)) == (1 if static else 3)

    @pytest.mark.parametrize("parallel", [False, True])
    def test_none_is_a_random_one(self, parallel):
        # a small image need not show the block
        options = {"parallel": parallel, "start_method": "fork", "obs_type": "vec"}
        env = ba_torchrl.make_vector_env("close_loop/block_reaching", 2, **options)
        try:
            seen = []
            for _ in range(2):
                assert env.set_seed(None) is None
                seen.append(env.reset()["observation"])
            assert len(torch.cat(seen).unique(dim=0)) == 4
        finally:
            env.close()

    @pytest.mark.parametrize("parallel", [False, True])
    def test_environment_i_has_seed_plus_i(self, make_fakes, parallel):
        env = make_fakes(3, seed=5, parallel=parallel)
        at_start = env.reset()["depth"]
        again = env.reset(seed=6)["depth"]
        assert torch.equal(again[:2], at_start[1:])
        assert torch.equal(env.reset(seed=5)["depth"], at_start)

    @pytest.mark.parametrize("parallel", [False, True])
    def test_refuses_invalid_seeds(self, make_fakes, parallel):
        env = make_fakes(1, parallel=parallel)
        for seed in (-1, 1.5, True):
            with pytest.raises(ValueError, match="natural number"):
                env.set_seed(seed)
            with pytest.raises(ValueError, match="natural number"):
                env.reset(seed=seed)


class TestResets:
    @pytest.mark.parametrize("options", [{"parallel": False}, {}])
    def test_partial(self, make_fakes, options):
        env = make_fakes(3, **options)
        state = env.reset()
        state = env.step(act(env, state))["next"].exclude("reward")
        mask = torch.tensor([[False], [True], [False]])
        after = env.reset(state.clone().set("_reset", mask))
        assert after["step_count"].flatten().tolist() == [1, 0, 1]
        same = (after["depth"] == state["depth"]).flatten(1).all(1)
        assert same.tolist() == [True, False, True]

    def test_of_none_changes_nothing(self, make_fakes):
        env = make_fakes()
        state = env.step(act(env, env.reset()))["next"].exclude("reward")
        mask = torch.zeros(2, 1, dtype=torch.bool)
        after = env.reset(state.clone().set("_reset", mask))
        assert torch.equal(after["depth"], state["depth"])
        assert after["step_count"].flatten().tolist() == [1, 1]

    @pytest.mark.parametrize("options", [{"parallel": False}, {}])
    def test_rollout_continues_after_done(self, make_fakes, options):
        env = make_fakes(horizon=3, **options)
        rollout = env.rollout(7, break_when_any_done=False)
        assert rollout.batch_size == (2, 7)
        assert rollout["next", "step_count"][0].flatten().tolist() == [1, 2, 3, 1, 2, 3, 1]
        assert rollout["next", "truncated"][1].flatten().tolist() == [False, False, True] * 2 + [
            False
        ]

    def test_steps_of_some(self, make_fakes):
        env = make_fakes(2)
        state = act(env, env.reset())
        state["_step"] = torch.tensor([True, False])
        result = env.step(state)
        assert result["next", "step_count"].flatten().tolist() == [1, 0]


class TestActions:
    invalid: ClassVar = {
        "environment 1 holds NaN": torch.tensor([[0.0, 0.0], [0.0, torch.nan]]),
        "environment 0 holds an infinite": torch.tensor([[0.0, torch.inf], [0.0, 0.0]]),
        r"environment 0 has shape \[3\]": torch.zeros(2, 3),
        "environment 0 has type torch.int64": torch.zeros(2, 2, dtype=torch.int64),
        "there is no action": None,
    }
    """Actions by the message."""

    @pytest.mark.parametrize("parallel", [False, True])
    @pytest.mark.parametrize("method", ["step", "step_and_maybe_reset"])
    def test_invalid_actions_are_refused_before_a_step(self, make_fakes, parallel, method):
        env = make_fakes(2, parallel=parallel)
        state = env.reset()
        allowed = r"float32 tensor of shape \[2\], from \[-1.0, -1.0\] to \[1.0, 1.0\]"
        for message, action in self.invalid.items():
            bad = state.clone() if action is None else state.clone().set("action", action)
            with pytest.raises(ValueError, match=rf"{message}.*{allowed}"):
                getattr(env, method)(bad)
        result = env.step(act(env, state))
        assert result["next", "step_count"].flatten().tolist() == [1, 1]
        assert getattr(env, "restarts", 0) == 0

    def test_of_environments_that_do_not_step_are_ignored(self, make_fakes):
        env = make_fakes(2)
        state = act(env, env.reset())
        state["action"][1] = torch.nan
        state["_step"] = torch.tensor([True, False])
        assert env.step(state)["next", "step_count"].flatten().tolist() == [1, 0]

    def test_actions_beyond_the_bounds_reach_the_environment(self, make_fakes):
        env = make_fakes(2)
        assert env.step(act(env, env.reset(), 5.0))["next", "reward"].flatten().tolist() == [10, 10]


def make_counting(horizon):
    return TransformedEnv(FakeEnv(horizon=horizon), StepCounter(step_count_key="inner"))


class TestWithTheRestOfTorchRL:
    @pytest.mark.parametrize("parallel", [False, True])
    def test_transforms_in_and_around_the_vector(self, parallel):
        workers = WorkerOptions(parallel=parallel, start_method="fork")
        factories = [partial(make_counting, horizon) for horizon in (2, 3)]
        vector = make_vector(factories, 2, seed=0, workers=workers)
        env = TransformedEnv(vector, StepCounter(step_count_key="outer"))
        try:
            check_env_specs(env, break_when_any_done="both", seed=0)
            counts = env.rollout(4, break_when_any_done=False)["next"]
            for key in ("step_count", "inner", "outer"):
                assert counts[key].squeeze(-1).tolist() == [[1, 2, 1, 2], [1, 2, 3, 1]]
        finally:
            env.close()

    @pytest.mark.parametrize("parallel", [False, True])
    def test_attributes_and_methods_are_those_of_the_environments(self, parallel):
        env = ba_torchrl.make_vector_env("close_loop/block_reaching", 2, parallel=parallel, **SMALL)
        try:
            env.reset()
            assert env.max_steps == [50, 50]
            shapes = [image.shape for image in env.render(width=8, height=4)]
            assert shapes == [(4, 8, 3), (4, 8, 3)]
            assert not hasattr(env, "no_such_name")
        finally:
            env.close()

    @pytest.mark.slow
    def test_spawn(self, make_fakes):
        env = make_fakes(2, seed=3, start_method="spawn", timeout_s=60.0)
        expected = make_fakes(2, seed=3, parallel=False).reset()
        before = env.reset()
        assert torch.equal(before["depth"], expected["depth"])
        os.kill(env.worker_pids[1], signal.SIGKILL)
        result, state = env.step_and_maybe_reset(act(env, before.clone()))
        assert_lost(result, 1, before)
        assert_stepped(result, 0, before)
        assert state["step_count"].flatten().tolist() == [1, 0]

    def test_observations_are_copies(self, make_fakes):
        env = make_fakes(2)
        state = env.reset()
        kept = state["depth"].clone()
        env.step(act(env, state.clone()))
        env.reset()
        assert torch.equal(state["depth"], kept)


class TestResources:
    def test_restarts_and_close_leak_nothing(self):
        def live():
            env = make_vector(FakeEnv, 2, seed=0, workers=FORK)
            state = env.reset()
            for _ in range(4):
                os.kill(env.worker_pids[0], signal.SIGKILL)
                _, state = env.step_and_maybe_reset(act(env, state))
            assert len(multiprocessing.active_children()) == 2
            pids = env.worker_pids
            env.close()
            assert multiprocessing.active_children() == []
            assert not any(os.path.exists(f"/proc/{pid}") for pid in pids)

        def held():
            gc.collect()
            return len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))

        live()  # opens what stays open for good
        before = held()
        live()
        assert all(now <= then for now, then in zip(held(), before, strict=True))

    def test_close_does_not_wait_for_a_hanging_worker(self, make_fakes):
        env = make_fakes(2)
        env.shutdown_timeout = 0.5
        os.kill(env.worker_pids[1], signal.SIGSTOP)
        env.close()
        assert multiprocessing.active_children() == []

    def test_threads_of_this_process(self, make_fakes):
        before = torch.get_num_threads()
        torch.set_num_threads(2)
        try:
            env = make_fakes(2)
            assert torch.get_num_threads() == 2
            env.close()
            assert torch.get_num_threads() == 2
        finally:
            torch.set_num_threads(before)


@pytest.mark.parametrize("number", [0, 2.0, "2"])
def test_refuses_impossible_sizes(number):
    with pytest.raises(ValueError, match="at least 1"):
        make_vector(FakeEnv, number)
    with pytest.raises(ValueError, match="2 functions were given for 3"):
        make_vector([FakeEnv, FakeEnv], 3)


@pytest.mark.parametrize(
    ("num_envs", "cores", "kind"),
    [
        (2, 16, SerialVectorEnv),
        (5, 2, SerialVectorEnv),
        (3, 3, VectorEnv),
    ],
)
def test_processes_start_by_default_where_three_run_at_a_time(monkeypatch, num_envs, cores, kind):
    monkeypatch.setattr("ba_torchrl.envs.vector.make.available_cores", lambda: cores)
    env = ba_torchrl.make_vector_env(
        "close_loop/block_reaching", num_envs, parallel=None, start_method="fork", obs_size=16
    )
    try:
        assert type(env) is kind
    finally:
        env.close()


def test_available_cores_are_those_of_the_process():
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("the cores of a process can be set on Linux only")
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert available_cores() == 1
    finally:
        os.sched_setaffinity(0, before)
    assert available_cores() == len(before)


def test_refuses_environments_that_cannot_report_a_fault():
    from torchrl.envs import GymEnv

    with pytest.raises(ValueError, match="fault"):
        VectorEnv(1, partial(GymEnv, "CartPole-v1"), workers=FORK)


def test_closing_serial_environments_keeps_the_number_of_threads(monkeypatch):
    monkeypatch.setattr("torchrl._THREAD_POOL_INIT", 8)  # TorchRL's upper limit
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        env = ba_torchrl.make_vector_env("close_loop/block_reaching", 2, parallel=False)
        env.reset()
        env.close()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
