import logging
import multiprocessing
import os
import pickle
import signal
import sys
from functools import partial
from types import ModuleType

import pytest
import torch
from fake_env import FakeEnv, act, assert_lost, assert_stepped

from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.core.errors import ConfigError, WorkerError
from ba_torchrl.envs.vector import parallel
from ba_torchrl.envs.vector.parallel import VectorEnv
from ba_torchrl.envs.vector.worker import SentError


class TestFailures:
    @pytest.mark.parametrize("order", ["raise", "hang", "kill"])
    def test_in_a_step(self, make_fakes, tmp_path, order, caplog):
        env = make_fakes(3, folder=tmp_path, timeout_s=5.0)
        before = env.step(act(env, env.reset()))["next"].exclude("reward")
        pids = env.worker_pids
        (tmp_path / f"{pids[1]}.step").write_text(order)
        with caplog.at_level(logging.WARNING, logger="ba_torchrl.envs.vector.parallel"):
            result = env.step(act(env, before.clone()))
        assert_lost(result, 1, before)
        for index in (0, 2):
            assert_stepped(result, index, before)
        assert env.restarts == 1
        assert env.worker_pids[0] == pids[0]
        assert env.worker_pids[1] != pids[1]
        assert not os.path.exists(f"/proc/{pids[1]}")
        cause = {"raise": "the simulator exploded", "hang": "within 5 s", "kill": "SIGKILL"}[order]
        assert "worker 1 is replaced" in caplog.text
        assert cause in caplog.text
        # The other episodes continue, the lost one starts again.
        _, state = env.step_and_maybe_reset(
            act(env, env.maybe_reset(env._step_mdp(result)).exclude("action"))
        )
        assert state["step_count"].flatten().tolist() == [3, 1, 3]

    @pytest.mark.parametrize("order", ["raise", "kill"])
    def test_in_step_and_maybe_reset(self, make_fakes, tmp_path, order):
        env = make_fakes(3, folder=tmp_path, timeout_s=5.0)
        _, before = env.step_and_maybe_reset(act(env, env.reset()))
        (tmp_path / f"{env.worker_pids[2]}.step").write_text(order)
        result, state = env.step_and_maybe_reset(act(env, before.clone()))
        assert_lost(result, 2, before)
        assert_stepped(result, 0, before)
        assert state["step_count"].flatten().tolist() == [2, 2, 0]
        assert not state["done"].any()
        assert not state["fault"].any()
        assert not torch.equal(state["depth"][2], before["depth"][2])
        result, state = env.step_and_maybe_reset(act(env, state))
        assert state["step_count"].flatten().tolist() == [3, 3, 1]
        assert env.restarts == 1

    @pytest.mark.parametrize("order", ["raise", "hang", "kill"])
    def test_in_a_reset_are_retried(self, make_fakes, tmp_path, order):
        env = make_fakes(2, folder=tmp_path, timeout_s=5.0)
        expected = env.reset(seed=3)["depth"]
        (tmp_path / f"{env.worker_pids[0]}.reset").write_text(order)
        state = env.reset(seed=3)
        assert env.restarts == 1
        assert torch.equal(state["depth"], expected)  # a seed that was asked for is kept
        assert not state["done"].any()
        assert_stepped(env.step(act(env, state.clone())), 0, state)

    @pytest.mark.parametrize("method", ["step", "step_and_maybe_reset"])
    def test_between_two_steps(self, make_fakes, method):
        env = make_fakes(3)
        before = env.reset()
        os.kill(env.worker_pids[1], signal.SIGKILL)
        result = getattr(env, method)(act(env, before.clone()))
        result = result if method == "step" else result[0]
        assert_lost(result, 1, before)
        assert_stepped(result, 2, before)
        assert env.restarts == 1

    def test_a_death_is_reported_after_a_reset_of_others(self, make_fakes):
        env = make_fakes(2)
        before = env.reset()
        os.kill(env.worker_pids[1], signal.SIGKILL)
        mask = torch.tensor([[True], [False]])
        state = env.reset(before.clone().set("_reset", mask))
        result = env.step(act(env, state.clone()))
        assert_stepped(result, 0, state)
        assert_lost(result, 1, before)

    def test_a_death_before_a_full_reset_is_not_reported(self, make_fakes):
        env = make_fakes(2)
        env.reset()
        os.kill(env.worker_pids[1], signal.SIGKILL)
        state = env.reset()
        result = env.step(act(env, state.clone()))
        for index in (0, 1):
            assert_stepped(result, index, state)
        assert env.restarts == 1

    @pytest.mark.timeout(60)
    def test_a_stopped_worker_with_a_full_pipe_is_killed(self, make_fakes):
        env = make_fakes(2, timeout_s=0.5)
        env.reset()
        worker = env._workers[1]
        os.kill(worker.process.pid, signal.SIGSTOP)
        worker.send("call", (bytes(2**22),), {})
        with pytest.raises(WorkerError, match="its process was ended by SIGKILL"):
            worker.receive()
        env.reset()
        assert env.restarts == 1

    def test_all_at_once(self, make_fakes, tmp_path):
        env = make_fakes(3, folder=tmp_path)
        before = env.reset()
        for pid in env.worker_pids:
            (tmp_path / f"{pid}.step").write_text("kill")
        result = env.step(act(env, before.clone()))
        for index in range(3):
            assert_lost(result, index, before)
        assert env.restarts == 3

    def test_fresh_seeds_are_the_same_in_every_run(self, make_fakes, tmp_path):
        def run(seed):
            env = make_fakes(2, seed=seed)
            first = env.reset()["depth"][1]
            images = [first]
            for _ in range(2):
                os.kill(env.worker_pids[1], signal.SIGKILL)
                images.append(env.reset()["depth"][1])
            return torch.stack(images)

        images = run(4)
        assert torch.equal(run(4), images)
        assert len(torch.cat([images, run(5)]).unique(dim=0)) == 6

    def test_without_end_raise(self, make_fakes, tmp_path):
        env = make_fakes(2, folder=tmp_path, max_restarts=2)
        state = env.reset()
        (tmp_path / "all.step").write_text("always raise")
        for _ in range(2):
            _, state = env.step_and_maybe_reset(act(env, state))
        with pytest.raises(RuntimeError, match=r"(?s)3 times.*exploded.*parallel=False"):
            env.step_and_maybe_reset(act(env, state))
        assert env.is_closed
        assert multiprocessing.active_children() == []

    def test_with_steps_in_between_add_up_until_an_episode_is_undisturbed(
        self, make_fakes, tmp_path, monkeypatch
    ):
        monkeypatch.setattr(parallel, "MAX_CONSECUTIVE_FAULTS", 3)
        env = make_fakes(1, folder=tmp_path, max_restarts=1)

        def fail_after_a_step(state):
            _, state = env.step_and_maybe_reset(act(env, state))
            (tmp_path / f"{env.worker_pids[0]}.step").write_text("raise")
            return env.step_and_maybe_reset(act(env, state))[1]

        for _ in range(2):
            state = fail_after_a_step(fail_after_a_step(env.reset()))
            env.step(act(env, state))
        state = fail_after_a_step(fail_after_a_step(env.reset()))
        assert env.restarts == 6
        with pytest.raises(RuntimeError, match=r"(?s)3 times without an undisturbed.*exploded"):
            fail_after_a_step(state)
        assert env.is_closed

    def test_in_endless_resets_raise(self, make_fakes, tmp_path):
        env = make_fakes(2, folder=tmp_path, max_restarts=2)
        (tmp_path / "all.reset").write_text("always raise")
        with pytest.raises(RuntimeError, match="worker 0 failed 3 times"):
            env.reset()
        assert env.is_closed

    @pytest.mark.parametrize("when", ["step", "reset"])
    @pytest.mark.parametrize(
        ("order", "error", "message"),
        [
            ("refuse", ConfigError, "the task is wrong"),
            ("mistake", KeyError, "'colour'"),
            ("private mistake", RuntimeError, "PrivateError: colour"),
            ("unprintable mistake", RuntimeError, "PrivateError, which cannot be printed"),
            ("exit", RuntimeError, "SystemExit: 0"),
        ],
    )
    def test_of_the_code_are_raised_at_once(
        self, make_fakes, tmp_path, when, order, error, message
    ):
        env = make_fakes(3, folder=tmp_path)
        state = act(env, env.reset())
        pids = env.worker_pids
        (tmp_path / f"{pids[1]}.{when}").write_text(order)
        with pytest.raises(error, match=f"^{message}$") as raised:
            env.step(state) if when == "step" else env.reset()
        assert "in _misbehave" in str(raised.value.__cause__)  # the worker's traceback
        state = env.reset()
        assert_stepped(env.step(act(env, state.clone())), 1, state)
        assert (env.restarts, env.worker_pids) == (0, pids)

    def test_of_any_size_fit_into_a_pipe(self):
        for message, kind in (("colour", KeyError), ("\N{SNOWMAN}" * 10**6, RuntimeError)):
            sent = SentError.of(KeyError(message)).shortened()
            assert len(pickle.dumps(sent)) < 2**16
            assert type(sent.received()) is kind
            assert str(sent.received()).startswith(("'colour'", "KeyError: '\N{SNOWMAN}"))

    def test_to_build_raise_with_the_cause(self, tmp_path):
        env = VectorEnv(
            2, partial(FakeEnv, folder=tmp_path), workers=WorkerOptions(start_method="fork")
        )
        (tmp_path / "build").touch()
        with pytest.raises(RuntimeError, match=r"(?s)could not be started.*no simulator today"):
            env.start()
        assert multiprocessing.active_children() == []

    @pytest.mark.slow
    def test_to_import_are_not_retried(self, monkeypatch):
        module = ModuleType("only_in_this_process")
        exec("def make():\n    import fake_env\n    return fake_env.FakeEnv()", vars(module))
        monkeypatch.setitem(sys.modules, module.__name__, module)
        env = VectorEnv(1, module.make, workers=WorkerOptions(start_method="spawn"))
        with pytest.raises(RuntimeError, match=r"worker 0 could not be started.*cannot import"):
            env.start()
        assert env.restarts == 0

    def test_to_rebuild_are_retried_then_raise(self, make_fakes, tmp_path):
        env = make_fakes(2, folder=tmp_path, max_restarts=1)
        state = act(env, env.reset())
        (tmp_path / "build").touch()
        os.kill(env.worker_pids[0], signal.SIGKILL)
        with pytest.raises(RuntimeError, match=r"(?s)failed 2 times.*no simulator today"):
            env.step(state)

    def test_an_interrupted_step_leaves_no_stale_answer(self, make_fakes, monkeypatch):
        env = make_fakes(2)
        before = env.reset()

        def interrupt(*_):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(parallel, "wait", interrupt)
            with pytest.raises(KeyboardInterrupt):
                env.step(act(env, before.clone()))
        state = env.reset()
        assert_stepped(env.step(act(env, state.clone())), 0, state)

    def test_an_unanswered_command_is_an_error(self, make_fakes):
        env = make_fakes(2)
        state = env.reset()
        assert list(env.horizon) == [1000, 1000]
        os.kill(env.worker_pids[0], signal.SIGKILL)
        with pytest.raises(RuntimeError, match="SIGKILL"):
            list(env.horizon)
        result = env.step(act(env, state.clone()))
        assert_lost(result, 0, state)
        assert_stepped(result, 1, state)
