"""Deaths that go on slow a vector of environments and do not end it; no worker survives it."""

import multiprocessing
import os
import signal
import time
from multiprocessing import resource_tracker
from pathlib import Path

import fake_env
import pytest
import torch
from fake_env import act, kill

import ba_torchrl
from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.vector import parallel
from ba_torchrl.envs.vector.worker import start_process
from tests.fresh import script

PARENT = """
import os, signal, sys, time
sys.path.insert(0, {tests!r})
from fake_env import FakeEnv
from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.envs.vector.make import make_vector

if __name__ == "__main__":
    env = make_vector(FakeEnv, 3, workers=WorkerOptions(start_method={method!r}))
    env.reset()
    os.kill(env.worker_pids[0], signal.SIGSTOP)  # hangs
    print(*env.worker_pids, flush=True)
    {end}
"""
THREAD = """
import os, signal, sys, threading, time
sys.path.insert(0, {tests!r})
from fake_env import FakeEnv, act
from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.envs.vector.make import make_vector

made = []
thread = threading.Thread(
    target=lambda: made.append(make_vector(FakeEnv, 3, workers=WorkerOptions(start_method="fork")))
)
thread.start()
thread.join()
(env,) = made
print(*env.worker_pids, flush=True)
time.sleep(0.2)
step = env.step(act(env, env.reset()))
assert not step["next", "fault"].any() and env.restarts == 0
print("stepped after the end of the thread", flush=True)
os.kill(env.worker_pids[0], signal.SIGSTOP)
time.sleep(1000)
"""
FAKES = Path(fake_env.__file__).parent


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until_gone(pids, seconds=60.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if not any(map(is_running, pids)):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize(
    ("how", "method"),
    [
        ("killed", "fork"),
        pytest.param("killed", "spawn", marks=pytest.mark.slow),
        ("ended", "fork"),
    ],
)
def test_no_worker_survives_its_parent(tmp_path, how, method):
    end = "time.sleep(1000)" if how == "killed" else "sys.exit(0)"
    with script(tmp_path, PARENT.format(tests=str(FAKES), method=method, end=end)) as parent:
        pids = printed_ids(tmp_path)
        if how == "killed":
            parent.kill()
        parent.join(60)
    assert parent.exitcode == (-signal.SIGKILL if how == "killed" else 0)
    assert wait_until_gone(pids)


def test_workers_of_a_thread_survive_the_thread_but_not_the_process(tmp_path):
    with script(tmp_path, THREAD.format(tests=str(FAKES))):
        pids = printed_ids(tmp_path)
        assert printed(tmp_path, 2)[1] == "stepped after the end of the thread"
    assert wait_until_gone(pids)


def printed_ids(folder):
    """Wait for the ids of the three workers of a script, and return them."""
    pids = [int(pid) for pid in printed(folder, 1)[0].split()]
    assert len(pids) == 3
    return pids


def printed(folder, count):
    """Wait for lines of a script's output, and return them."""
    out, deadline = folder / "stdout", time.monotonic() + 240
    while not out.exists() or out.read_text().count("\n") < count:
        assert time.monotonic() < deadline, (folder / "stderr").read_text()
        time.sleep(0.02)
    return out.read_text().splitlines()


def test_a_trickle_of_deaths_does_not_end_the_environments(make_fakes):
    env = make_fakes(2, max_restarts=1)
    state, lost = env.reset(), 0
    for number in range(8):
        # between two steps, in turn, and sooner than any completes one
        kill(env.worker_pids[number % 2])
        step, state = env.step_and_maybe_reset(act(env, state))
        lost += int(step["next", "fault"].sum())
    assert env.restarts == lost == 8
    step, state = env.step_and_maybe_reset(act(env, state))
    assert not step["next", "fault"].any()


def test_workers_that_ended_together_start_together(make_fakes, monkeypatch):
    env = make_fakes(3)
    state = env.reset()
    order = []

    class Recorded(parallel.Worker):
        def __init__(self, *args):
            super().__init__(*args)
            order.append("launch")

        def wait_until_ready(self):
            order.append("wait")
            super().wait_until_ready()

    monkeypatch.setattr(parallel, "Worker", Recorded)
    for pid in env.worker_pids[:2]:
        kill(pid)
    env.step(act(env, state))
    assert order == ["launch", "launch", "wait", "wait"]


def test_signals_for_all_processes_leave_the_workers_to_the_parent(make_fakes):
    env = make_fakes(2)
    state = env.reset()
    for pid in env.worker_pids:
        os.kill(pid, signal.SIGTERM)
        os.kill(pid, signal.SIGINT)
    step = env.step(act(env, state))
    assert not step["next", "fault"].any()
    assert env.restarts == 0


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_worker_receives_no_interruption_while_it_starts(monkeypatch, method):
    tracker = resource_tracker.ResourceTracker()  # one that does not run yet
    for name in ("ensure_running", "getfd"):
        monkeypatch.setattr(resource_tracker, name, getattr(tracker, name))
    process = multiprocessing.get_context(method).Process(target=time.sleep, args=(60,))
    try:
        start_process(process)
        status = Path(f"/proc/{process.pid}/status").read_text()
    finally:
        process.kill()
        process.join()
        tracker._stop()
    blocked = int(status.split("SigBlk:")[1].split()[0], 16)
    assert blocked & 1 << (signal.SIGINT - 1)
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_worker_options_are_an_object_or_keywords_of_make_vector_env():
    env = ba_torchrl.make_vector_env(
        "close_loop/block_reaching",
        1,
        workers=WorkerOptions(start_method="fork", timeout_s=7.0, max_restarts=2),
        max_restarts=3,
        wait_for_restarts=False,
        obs_size=16,
        seed=0,
    )
    expected = {"timeout_s": 7.0, "max_restarts": 3, "wait_for_restarts": False}
    assert env.workers == WorkerOptions(start_method="fork", **expected)
    with pytest.raises(ConfigError, match=r"workers:\n  timeout_s: .* greater than 0"):
        ba_torchrl.make_vector_env("close_loop/block_reaching", 1, timeout_s=0)
    assert isinstance(env.reset()["depth"], torch.Tensor)
    env.close()
