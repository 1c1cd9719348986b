"""Workers are killed and stopped at random while a vector of environments steps.

``BA_STORM_SECONDS`` is the duration, by default 60 s. Each environment writes a checksum of its
transition into the observation.
"""

import json
import os
import random
import signal
import sys
import threading
import time
import zlib
from functools import partial

import pytest
import torch
from fake_env import FakeEnv, act
from torchrl.collectors import Collector

from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.envs.vector.make import make_vector

SECONDS = float(os.environ.get("BA_STORM_SECONDS", "60"))
CALM_S = min(10.0, SECONDS)
NUM_ENVS = 3
INTERVAL_S = {"fork": (1.0, 3.0), "spawn": (10.0, 20.0)}
"""Seconds between two signals: a spawned worker takes several seconds to start."""


class SealedEnv(FakeEnv):
    """One pixel is the id of the process, one a checksum of the others and of the step count."""

    def _observe(self, **flags):
        out = super()._observe(**flags)
        out["depth"][0, 0, 1] = os.getpid()
        out["depth"][0, 0, 0] = checksum(out)
        return out


def checksum(transition):
    """Return a checksum of the image, without its corner, and of the step count."""
    depth = transition["depth"].clone()
    depth[0, 0, 0] = 0
    data = depth.numpy().tobytes() + transition["step_count"].numpy().tobytes()
    return zlib.crc32(data) % 2**20  # exact in float32


class Storm:
    """Context in which a thread kills and stops, in turns, random workers of a vector."""

    def __init__(self, env, interval_s):
        self.env, self.interval_s = env, interval_s
        self.generator = random.Random(0)
        self.sent = {signal.SIGKILL: 0, signal.SIGSTOP: 0}
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.run)

    def run(self):
        while not self.ended.wait(self.generator.uniform(*self.interval_s)):
            number = min(self.sent, key=self.sent.get)
            try:
                os.kill(self.env.worker_pids[self.generator.randrange(NUM_ENVS)], number)
            except (ProcessLookupError, ValueError, IndexError):  # it is replaced now
                continue
            self.sent[number] += 1

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.ended.set()
        self.thread.join()


def collect(steps, seconds, seen):
    """Collect and check transitions for some time; return the frames per second and the faults."""
    start, frames, faults = time.perf_counter(), 0, 0
    while time.perf_counter() - start < seconds:
        for transition in next(steps).reshape(-1):
            following = transition["next"]
            if following["fault"]:
                faults += not transition["fault"]  # else its worker starts
                continue
            for part in (transition, following):  # not torn
                assert part["depth"][0, 0, 0] == checksum(part)
            assert following["step_count"] == transition["step_count"] + 1
            assert following["reward"].item() == pytest.approx(transition["action"].sum().item())
            name = following["depth"].numpy().tobytes()
            assert name not in seen  # not duplicated
            seen.add(name)
            frames += 1
    return frames / (time.perf_counter() - start), faults


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_no_transition_is_torn_or_duplicated_in_a_storm(method, tmp_path, capsys):
    workers = WorkerOptions(
        start_method=method, timeout_s=2.0, max_restarts=20, wait_for_restarts=False
    )
    factory = partial(SealedEnv, horizon=20, work_s=0.002)
    env = make_vector(factory, NUM_ENVS, seed=0, workers=workers)
    collector = Collector(
        env,
        lambda td: act(env, td, value=torch.rand(()).item()),
        frames_per_batch=NUM_ENVS,
        total_frames=-1,
    )
    steps, seen = iter(collector), set()
    try:
        before, faults = collect(steps, CALM_S, seen)
        assert faults == env.restarts == 0
        with Storm(env, INTERVAL_S[method]) as storm:
            during, faults = collect(steps, SECONDS, seen)
        restarts = env.restarts
        after, _ = collect(steps, CALM_S, seen)
    finally:
        collector.shutdown()
    kills, stops = storm.sent.values()
    figures = {"frames/s before": before, "during": during, "after": after, "faults": faults}
    figures |= {"restarts": restarts, "killed": kills, "stopped": stops}
    with capsys.disabled():
        sys.stdout.write(f"\n{method}: {json.dumps(figures)}\n")
    assert kills > 0
    assert stops > 0
    assert 0 < faults <= restarts
    assert during > 0.02 * before
