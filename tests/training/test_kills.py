"""A process killed at random moments and resumed ends with the bits of an undisturbed one."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest

from tests.training.test_interruption import SAC, assert_same, config_for, outcome

KILLS = 10
SETTINGS = {**SAC, "parallel": True, "start_method": "fork", "save_minutes": 0.01}


def start(folder):
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
        stdin.write(json.dumps({**SETTINGS, "run_dir": str(folder), "resume": True}))
    return process


def finish(folder):
    """Run to the end; return all that was learnt and recorded."""
    from ba_torchrl.training.checkpoint import load

    process = start(folder)
    assert process.wait(300) == 0, process.stderr.read()[-2000:]
    _, algorithm = load(folder, "latest")
    holder = type("Holder", (), {"config": config_for(folder, SETTINGS), "algorithm": algorithm})
    return outcome(holder)


def test_a_signal_to_the_whole_group_saves_the_run(tmp_path):
    """Schedulers and terminals signal the workers, too."""
    process = start(tmp_path)
    for _ in range(1200):
        if list((tmp_path / "resume").glob("checkpoint-*")):
            break
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGTERM)
    assert process.wait(60) == 128 + signal.SIGTERM
    lines = process.stderr.read().splitlines()
    assert "stopped by SIGTERM, state saved" in lines[-1]
    assert not any("replaced" in line for line in lines)


@pytest.mark.slow
def test_a_run_killed_at_random_moments_ends_with_the_same_bits(tmp_path):
    undisturbed = finish(tmp_path / "whole")
    generator = random.Random(0)
    killed = 0
    for _ in range(KILLS):
        process = start(tmp_path / "run")
        try:
            process.wait(generator.uniform(5, 12))  # starting takes several seconds
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            killed += 1
    assert killed
    assert_same(finish(tmp_path / "run"), undisturbed)
