"""Compare the speed of this library's pick task with those of other libraries, on one CPU thread.

python recipes/peers.py                   # installs all in build/peers, measures, prints a table
python recipes/peers.py --steps 2000

A virtual environment of their own is made: their requirements differ from those of development.
MuJoCo renders by OSMesa (Debian's libosmesa6), PyBullet by TinyRenderer. Actions are uniform in the
action space; resets are not measured.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import time
import venv
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).parents[1]
TORCH = "torch==2.13.0"
PEERS = ("panda-gym==3.0.7", "robosuite==1.5.2", "metaworld==3.1.1", "gymnasium-robotics==1.4.2")
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",  # threads of Mesa's rasteriser besides the caller's
    "MUJOCO_GL": "osmesa",
    "PYOPENGL_PLATFORM": "osmesa",
}
WARM_UP_STEPS = 20
PIXELS = 128

Step = Callable[[], bool]
"""Take a random action, with the image if there is one; return whether the episode has ended."""


def panda_gym(image: bool) -> tuple[Step, Callable[[], object]]:
    """PandaPickAndPlace-v3. It has no depth in its interface: a colour image."""
    import gymnasium
    import panda_gym  # noqa: F401

    size = {"render_width": PIXELS, "render_height": PIXELS}
    env = gymnasium.make("PandaPickAndPlace-v3", render_mode="rgb_array", renderer="Tiny", **size)
    return gymnasium_step(env, image), env.reset


def gymnasium_robotics(image: bool) -> tuple[Step, Callable[[], object]]:
    """FetchPickAndPlace-v4. It has no depth in its interface: a colour image."""
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    mode = "rgb_array" if image else None
    env = gymnasium.make("FetchPickAndPlace-v4", render_mode=mode, width=PIXELS, height=PIXELS)
    return gymnasium_step(env, image), env.reset


def metaworld(image: bool) -> tuple[Step, Callable[[], object]]:
    """pick-place-v3."""
    import gymnasium
    import metaworld  # noqa: F401

    options = {"render_mode": "depth_array" if image else None, "width": PIXELS, "height": PIXELS}
    env = gymnasium.make("Meta-World/MT1", env_name="pick-place-v3", **options)
    return gymnasium_step(env, image), env.reset


def robosuite(image: bool) -> tuple[Step, Callable[[], object]]:
    """Lift with the Panda and its default controller."""
    import numpy as np
    import robosuite

    camera = {
        "camera_names": "frontview",
        "camera_depths": True,
        "camera_heights": PIXELS,
        "camera_widths": PIXELS,
    }
    env = robosuite.make(
        "Lift",
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=image,
        use_camera_obs=image,
        **camera if image else {},
    )
    low, high = env.action_spec
    generator = np.random.default_rng(0)
    return lambda: env.step(generator.uniform(low, high))[2], env.reset


def ba_torchrl(image: bool, **options: Any) -> tuple[Step, Callable[[], object]]:
    """close_loop/block_picking with the Panda, by TorchRL's interface."""
    import torch

    from ba_torchrl import make

    torch.set_num_threads(1)
    seen = {"obs_size": PIXELS} if image else {"obs_type": "vec"}
    env = make("close_loop/block_picking", robot="panda", **seen, **options)

    return lambda: bool(env.rand_step()["next", "done"].any()), env.reset


def gymnasium_step(env: Any, image: bool) -> Step:
    """Return the step of a Gymnasium environment; `image` renders after it."""

    def step() -> bool:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if image:
            env.render()
        return terminated or truncated

    return step


LIBRARIES = {
    "BA-TorchRL": (ba_torchrl, "depth", "a motion of 0.21 s, of which 0.06 s near objects"),
    "BA-TorchRL, `fast_mode=False`": (
        partial(ba_torchrl, fast_mode=False),
        "depth",
        "a motion of 0.21 s",
    ),
    "panda-gym 3.0.7": (panda_gym, "colour", "0.04 s, inverse kinematics"),
    "robosuite 1.5.2": (robosuite, "colour and depth", "0.05 s, operational space"),
    "Meta-World 3.1.1": (metaworld, "depth", "0.0125 s, mocap weld"),
    "Gymnasium-Robotics 1.4.2": (gymnasium_robotics, "colour", "0.04 s, mocap weld"),
}
"""The start of an environment, its image, and what a step simulates."""


def steps_per_second(library: str, image: bool, steps: int) -> float:
    """Return the rate of steps without resets."""
    step, reset = LIBRARIES[library][0](image)
    reset()
    for _ in range(WARM_UP_STEPS):
        if step():
            reset()
    seconds = 0.0
    for _ in range(steps):
        start = time.perf_counter()
        done = step()
        seconds += time.perf_counter() - start
        if done:
            reset()
    return steps / seconds


def measured(python: Path, library: str, image: bool, steps: int) -> float:
    """Return `steps_per_second` of a process of its own.

    Raises:
        RuntimeError: it fails; with its output.
    """
    command = [str(python), __file__, "--measure", json.dumps([library, image, steps])]
    environment = {**os.environ, **ONE_THREAD}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if run.returncode:
        raise RuntimeError(f"{library} with image={image}:\n{run.stderr}")
    return float(run.stdout.split()[-1])


def installed(folder: Path) -> Path:
    """Return the interpreter of an environment with all libraries, made if it is not there."""
    python = folder / "bin" / "python"
    complete = folder / "complete"
    if not complete.exists():
        venv.create(folder, with_pip=True, clear=True)
        pip = [str(python), "-m", "pip", "install", "--quiet"]
        subprocess.run([*pip, TORCH], check=True)  # first: a requirement would take another build
        subprocess.run([*pip, str(ROOT), *PEERS], check=True)
        complete.touch()
    return python


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "peers")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=3, help="the median is printed")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(steps_per_second(*json.loads(arguments.measure)))
        return
    python = installed(arguments.folder)
    rates: dict[tuple[str, bool], list[float]] = {}
    for _ in range(arguments.repeats):  # in turns, so that a slow minute meets all of them
        for library in LIBRARIES:
            for image in (True, False):
                rate = measured(python, library, image, arguments.steps)
                rates.setdefault((library, image), []).append(rate)
    print("| library | steps/s with an image | steps/s without | image | a step simulates |")
    print("|---|---|---|---|---|")
    for library, (_, image, simulated) in LIBRARIES.items():
        with_image, without = (f"{median(rates[library, each]):.0f}" for each in (True, False))
        print(f"| {library} | {with_image} | {without} | {image} | {simulated} |")


if __name__ == "__main__":
    main()
