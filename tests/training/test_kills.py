"""A process killed at random moments and resumed ends with the bits of an undisturbed one."""

import os
import pickle
import random
import signal
import time
from types import SimpleNamespace

import pytest

from tests.fresh import script
from tests.training.test_interruption import SAC, assert_same, config_for, outcome

KILLS = 10
SETTINGS = {**SAC, "parallel": True, "start_method": "fork", "save_minutes": 0.01}


CODE = """
import os, sys
os.setsid()
sys.stdin = open("config.pkl")
sys.argv[1:] = ["run", str(os.getppid())]
from ba_torchrl.training.grid.run_one import main
main()
"""


def start(folder, **changes):
    """The process of a run, which leads a group of its own; its files are beside the run."""
    config = config_for(folder, {**SETTINGS, **changes, "resume": True})
    (folder.parent / "config.pkl").write_bytes(pickle.dumps(config))
    return script(folder.parent, CODE)


def messages(folder):
    return (folder.parent / "stderr").read_text()


def newest_state(folder):
    states = [path.name for path in (folder / "resume").glob("checkpoint-*")]
    return max(states, default=None)


def wait_for(condition, process):
    deadline = time.monotonic() + 240
    while not condition():
        assert process.exitcode is None
        assert time.monotonic() < deadline
        time.sleep(0.02)


def finish(folder, **changes):
    """Run to the end; return all that was learnt and recorded."""
    from ba_torchrl.training.checkpoint import load

    with start(folder, **changes) as process:
        process.join(300)
    assert process.exitcode == 0, messages(folder)[-2000:]
    _, algorithm = load(folder, "latest")
    config = config_for(folder, {**SETTINGS, **changes})
    return outcome(SimpleNamespace(config=config, algorithm=algorithm))


def test_a_signal_to_the_whole_group_saves_the_run(tmp_path):
    """Schedulers and terminals signal the workers, too."""
    folder = tmp_path / "run"
    with start(folder) as process:
        wait_for(lambda: newest_state(folder), process)
        os.killpg(process.pid, signal.SIGTERM)
        process.join(240)
    assert process.exitcode == 128 + signal.SIGTERM
    lines = messages(folder).splitlines()
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
        with start(folder, **values) as process:
            if number % 2:
                wait_for(lambda before=before: newest_state(folder) != before, process)
                time.sleep(generator.uniform(0, 2))
            else:
                time.sleep(generator.uniform(0, 6))
            assert process.exitcode is None, "the run ended too early to be killed"
        reached.add(newest_state(folder))
    assert len(reached) >= KILLS // 2, reached
    assert_same(finish(folder, **values), finish(tmp_path / "whole", **values))
