"""Shared parts of the tests of vectors: a small environment that fails on demand, and checks."""

import contextlib
import multiprocessing
import os
import sys
import time
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from ba_torchrl.core.errors import ConfigError, SimulationError

FLAGS = ("done", "terminated", "truncated")


def flag():
    return Binary(n=1, shape=(1,), dtype=torch.bool)


class FakeEnv(EnvBase):
    """Pixels are drawn from the seed; the reward is the sum of the action.

    A file named ``<pid>.<when>`` (when: step, reset) in ``folder`` makes that process raise,
    refuse, make a mistake, exit, hang or die as the file says; it is removed first, unless the word
    starts with "always".
    A file named ``build`` makes every constructor raise, kill its process (``kill``), or wait until
    the file is removed (``wait``).
    """

    def __init__(self, folder=None, horizon=1000, size=4, work_s=0.0):
        super().__init__(device="cpu", batch_size=[])
        self.folder = None if folder is None else Path(folder)
        self.horizon = horizon
        self.size = size
        self.work_s = work_s
        self.observation_spec = Composite(
            depth=Bounded(0, 1, shape=(1, size, size), dtype=torch.float32),
            holding=flag(),
            success=flag(),
            fault=flag(),
            step_count=Unbounded(shape=(1,), dtype=torch.int64),
        )
        self.action_spec = Bounded(-1, 1, shape=(2,), dtype=torch.float32)
        self.reward_spec = Unbounded(shape=(1,), dtype=torch.float32)
        self.full_done_spec = Composite({key: flag() for key in FLAGS})
        self.generator = torch.Generator()
        self.count = None
        if self.folder is not None:
            # a test may remove the file at any time
            with contextlib.suppress(FileNotFoundError):
                self._fail_to_build(self.folder / "build")

    def _fail_to_build(self, path):
        order = path.read_text()
        if order == "kill":
            os.kill(os.getpid(), 9)
        if order != "wait":
            raise OSError("no simulator today")
        while path.exists():
            time.sleep(0.01)

    def _set_seed(self, seed):
        self.generator.manual_seed(seed)

    def _misbehave(self, when):
        if self.folder is None:
            return
        for name in (f"{os.getpid()}.{when}", f"all.{when}"):
            path = self.folder / name
            if path.exists():
                order = path.read_text()
                if not order.startswith("always"):
                    path.unlink()
                if order == "refuse":
                    raise ConfigError("the task is wrong")
                if order == "mistake":
                    raise KeyError("colour")
                if order == "private mistake":
                    raise type("PrivateError", (Exception,), {})("colour")
                if order == "unprintable mistake":
                    raise type("PrivateError", (Exception,), {"__str__": lambda _: 1 / 0})
                if order == "exit":
                    sys.exit(0)
                if order.endswith("raise"):
                    raise SimulationError("the simulator exploded")
                if order.endswith("hang"):
                    time.sleep(1000)
                os.kill(os.getpid(), 9)

    def _observe(self, **flags):
        out = {
            "depth": torch.rand(1, self.size, self.size, generator=self.generator),
            "step_count": torch.tensor([self.count]),
            **{key: torch.tensor([False]) for key in ("holding", "success", "fault")},
            **{key: torch.tensor([flags.get(key, False)]) for key in FLAGS},
        }
        return TensorDict(out, batch_size=[])

    def _reset(self, tensordict=None, *, seed=None, **kwargs):
        self._misbehave("reset")
        if seed is not None:
            self._set_seed(seed)
        self.count = 0
        return self._observe()

    def _step(self, tensordict):
        self._misbehave("step")
        if self.work_s:
            end = time.perf_counter() + self.work_s
            while time.perf_counter() < end:
                pass
        self.count += 1
        end = self.count >= self.horizon
        out = self._observe(truncated=end, done=end)
        out["reward"] = tensordict["action"].sum(-1, keepdim=True)
        return out


def kill(pid):
    """Kill a worker process and wait until it has ended."""
    (process,) = (each for each in multiprocessing.active_children() if each.pid == pid)
    process.kill()
    process.join()


def act(env, td, value=0.1):
    return td.set("action", torch.full((*env.batch_size, 2), value))


def assert_lost(result, index, before):
    """Check that ``result`` reports the loss of one environment's episode after ``before``."""
    answer = result["next"][index]
    assert torch.equal(answer["depth"], before["depth"][index])
    for key in ("fault", "truncated", "done"):
        assert answer[key].item(), key
    for key in ("success", "terminated"):
        assert not answer[key].item(), key
    assert answer["reward"].item() == 0


def assert_stepped(result, index, before):
    answer = result["next"][index]
    assert not torch.equal(answer["depth"], before["depth"][index])
    assert answer["step_count"].item() == before["step_count"][index].item() + 1
    assert not answer["fault"].item()
    assert answer["reward"].item() == pytest.approx(0.2)
