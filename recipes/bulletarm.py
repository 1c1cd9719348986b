r"""Compare the duration of a step with that of BulletArm, on one CPU thread.

git clone https://github.com/ColinKohler/BulletArm
python3.11 -m venv bulletarm-venv
bulletarm-venv/bin/pip install 'numpy<2' pybullet scipy scikit-image opencv-python-headless \
    tqdm gitpython
python recipes/bulletarm.py BulletArm --python bulletarm-venv/bin/python

Each task runs in two processes, which play an episode in turns, so that a slow minute meets both.
Measured is the CPU time of `step`, which other programs delay but do not add to: the arm's motion,
the test of the goal, and the observation with its image of 128 px. Resets and the choice of actions
are left out; actions are those of BulletArm's planner and of this library's expert. Both have the
same robot, number of objects and form of actions, and otherwise their defaults: BulletArm simulates
all of a close-loop motion, this library the part near objects. The first episode is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from statistics import mean, median
from typing import Any

from peers import ONE_THREAD, PIXELS

TASKS = {
    "close_loop/block_picking": "close_loop_block_picking",
    "close_loop/block_reaching": "close_loop_block_reaching",
    "close_loop/block_stacking": "close_loop_block_stacking",
    "close_loop/drawer_opening": "close_loop_drawer_opening",
    "close_loop/object_grasping": "close_loop_clutter_picking",
    "open_loop/block_stacking": "block_stacking",
    "open_loop/house_building_4": "house_building_4",
    "open_loop/bottle_arrangement": "bottle_tray",
    "open_loop/box_palletizing": "box_palletizing",
    "open_loop/covid_test": "covid_test",
    "open_loop/bin_packing": "block_bin_packing",
    "open_loop/object_grasping": "object_grasping",
    "ramp/block_stacking": "ramp_block_stacking",
}
"""BulletArm's name of each task."""
SAME_SETTINGS = ("robot", "action_sequence", "num_objects", "in_hand_size", "in_hand_mode")
PLAY = "--play"
HEADER = """\
| task | BulletArm, ms | BA-TorchRL, ms | ratio | physics steps of BulletArm | of BA-TorchRL |
|---|---|---|---|---|---|"""

Steps = list[tuple[float, int]]
"""CPU seconds and number of physics steps of each step of the environment."""


def settings_of(task: str) -> dict[str, Any]:
    """Return the settings that both environments of a task are made with."""
    from ba_torchrl.envs.settings import resolve_env

    config = resolve_env(task, {}).config
    values = {name: getattr(config, name) for name in SAME_SETTINGS}
    return {"obs_size": PIXELS, **{name: value for name, value in values.items() if value}}


def bulletarm_episodes(checkout: str, task: str, settings: dict[str, Any]) -> Iterator[Steps]:
    """Play episodes of BulletArm with its planner's actions."""
    sys.path[0] = checkout  # in place of the folder of this file, which is named bulletarm as well
    try:
        import pybullet

        from bulletarm import env_factory
    except ImportError as error:
        sys.exit(f"{sys.executable} cannot import BulletArm, see the top of {__file__}: {error}")

    simulate, physics = pybullet.stepSimulation, 0

    def counted(*arguments: Any, **options: Any) -> Any:
        nonlocal physics
        physics += 1
        return simulate(*arguments, **options)

    pybullet.stepSimulation = counted  # which takes less than a thousandth of a step
    runner = env_factory.createEnvs(0, TASKS[task], {**settings, "seed": 0}, {})
    while True:
        runner.reset()
        steps: Steps = []
        done = False
        while not done:
            action, before = runner.getNextAction(), physics
            start = time.process_time()
            _, _, done, *_ = runner.env.step(action)
            steps.append((time.process_time() - start, physics - before))
        yield steps


def ba_torchrl_episodes(task: str, settings: dict[str, Any]) -> Iterator[Steps]:
    """Play episodes of this library with its expert's actions."""
    from ba_torchrl import make
    from ba_torchrl.core import keys
    from profiling.simulation import SEED, expert_episodes

    with closing(make(task, seed=SEED, **settings)) as env:
        for actions in expert_episodes(task, **settings):
            state = env.reset()
            steps: Steps = []
            for action in actions:
                state[keys.ACTION] = action
                before = env.scene.world.steps
                start = time.process_time()
                result = env.step(state)
                steps.append((time.process_time() - start, env.scene.world.steps - before))
                state = result[keys.NEXT]
            yield steps


EPISODES = {"BulletArm": bulletarm_episodes, "BA-TorchRL": ba_torchrl_episodes}


def play(library: str, *job: Any) -> None:
    """Play an episode for each line of the standard input, and write it as a line."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # PyBullet prints
    episodes = EPISODES[library](*job)
    for _ in sys.stdin:
        print(json.dumps(next(episodes)), file=answers, flush=True)


@contextmanager
def player(python: str, library: str, *job: Any) -> Iterator[Callable[[], Steps]]:
    """Start a process that plays an episode at each call.

    Raises:
        RuntimeError: the process ends; it has written why.
    """
    command = [python, __file__, PLAY, json.dumps([library, *job])]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "bufsize": 0}
    with subprocess.Popen(command, env={**os.environ, **ONE_THREAD}, **pipes) as process:

        def episode() -> Steps:
            with suppress(BrokenPipeError):
                process.stdin.write(b"\n")
            line = process.stdout.readline()
            if not line:
                raise RuntimeError(f"the process of {library} ended: {' '.join(command)}")
            return json.loads(line)

        yield episode


def measured(checkout: Path, python: str, task: str, steps: int) -> tuple[Steps, Steps]:
    """Return the steps of BulletArm and of this library, at least `steps` of each.

    Raises:
        RuntimeError: a process ends.
    """
    settings = settings_of(task)
    with (
        player(python, "BulletArm", str(checkout.resolve()), task, settings) as theirs,
        player(sys.executable, "BA-TorchRL", task, settings) as ours,
    ):
        for episode in (theirs, ours):
            episode()
        found: tuple[Steps, Steps] = ([], [])
        while min(map(len, found)) < steps:
            for all_steps, episode in zip(found, (theirs, ours), strict=True):
                all_steps += episode()
    return found


def row(task: str, theirs: Steps, ours: Steps) -> str:
    """Return a task's row of the table: medians of the durations, means of the physics steps."""
    (their_s, their_physics), (our_s, our_physics) = (
        (median(seconds), mean(physics))
        for seconds, physics in (zip(*steps, strict=True) for steps in (theirs, ours))
    )
    durations = f"{float(f'{1e3 * their_s:.3g}'):g} | {float(f'{1e3 * our_s:.3g}'):g}"
    physics = f"{their_physics:.0f} | {our_physics:.1f}"
    return f"| `{task}` | {durations} | {their_s / our_s:.0f} | {physics} |"


def main(words: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkout", type=Path, help="a clone of BulletArm")
    parser.add_argument("--python", required=True, help="an interpreter with BulletArm's packages")
    parser.add_argument("--steps", type=int, default=100, help="of each task, at least")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), metavar="TASK")
    arguments = parser.parse_args(words)
    if not (arguments.checkout / "bulletarm" / "env_factory.py").is_file():
        parser.error(f"{arguments.checkout} is no clone of BulletArm: no bulletarm/env_factory.py")
    if shutil.which(arguments.python) is None:
        parser.error(f"--python {arguments.python} is no program")
    if arguments.steps < 1:
        parser.error("--steps must be 1 or more")
    print(HEADER)
    for task in arguments.tasks:
        try:
            steps = measured(arguments.checkout, arguments.python, task, arguments.steps)
        except RuntimeError as error:
            sys.exit(str(error))
        print(row(task, *steps), flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == [PLAY]:
        play(*json.loads(sys.argv[2]))
    else:
        main()
