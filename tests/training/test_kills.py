"""A process killed at random moments and resumed ends with the bits of an undisturbed one."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from tests.training.test_interruption import SAC, assert_same, config_for, outcome

KILLS = 10
SETTINGS = {**SAC, "parallel": True, "start_method": "fork", "save_minutes": 0.01}


def start(folder, **changes):
    """Start a training process, which leads a group of its own."""
    process = subprocess.Popen(
        [sys.executable, "-m", "ba_torchrl.training.grid.run_one"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    with process.stdin as stdin:
        stdin.write(json.dumps({**SETTINGS, **changes, "run_dir": str(folder), "resume": True}))
    return process


def newest_state(folder):
    states = [path.name for path in (folder / "resume").glob("checkpoint-*")]
    return max(states, default=None)


def wait_for(condition, process):
    deadline = time.monotonic() + 60
    while not condition():
        assert process.poll() is None, process.stderr.read()[-2000:]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def finish(folder, **changes):
    """Run to the end; return all that was learnt and recorded."""
    from ba_torchrl.training.checkpoint import load

    process = start(folder, **changes)
    assert process.wait(300) == 0, process.stderr.read()[-2000:]
    _, algorithm = load(folder, "latest")
    config = config_for(folder, {**SETTINGS, **changes})
    return outcome(SimpleNamespace(config=config, algorithm=algorithm))


def test_a_signal_to_the_whole_group_saves_the_run(tmp_path):
    """Schedulers and terminals signal the workers, too."""
    process = start(tmp_path)
    wait_for(lambda: newest_state(tmp_path), process)
    os.killpg(process.pid, signal.SIGTERM)
    assert process.wait(60) == 128 + signal.SIGTERM
    lines = process.stderr.read().splitlines()
    assert "stopped by SIGTERM, state saved" in lines[-1]
    assert not any("replaced" in line for line in lines)


@pytest.mark.slow
def test_a_run_killed_at_random_moments_ends_with_the_same_bits(tmp_path):
    """Every second kill comes at any time of the start, the others after progress."""
    values = {"total_updates": 600, "eval_every": 40}
    folder, generator = tmp_path / "run", random.Random(0)
    reached = set()
    for number in range(KILLS):
        before = newest_state(folder)
        process = start(folder, **values)
        if number % 2:
            wait_for(lambda before=before: newest_state(folder) != before, process)
            time.sleep(generator.uniform(0, 2))
        else:
            time.sleep(generator.uniform(0, 6))
        assert process.poll() is None, "the run ended too early to be killed"
        process.kill()
        process.wait()
        reached.add(newest_state(folder))
    assert len(reached) >= KILLS // 2, reached
    assert_same(finish(folder, **values), finish(tmp_path / "whole", **values))
