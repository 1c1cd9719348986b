"""Times of steps, resets and images, also as multiples of a step of PyBullet."""

from __future__ import annotations

import contextlib
import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pybullet
import torch
from tensordict import TensorDictBase
from torch import Tensor

from ba_torchrl import list_tasks, make
from ba_torchrl.envs import keys
from ba_torchrl.envs.base import ManipulationEnv
from ba_torchrl.profiling.numpy_camera import NumpyHeightCamera
from ba_torchrl.profiling.table import Bench, Budget, Row, measurement, seconds, timed_row
from ba_torchrl.sim.geometry import downward
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import TASKS

SEED = 0
CAMERA_M = 1.0
SLIP_TASKS = ("open_loop/block_stacking", "open_loop/bin_packing", "ramp/house_building_1")


class SimulationUnit:
    """One `stepSimulation` of kuka, floor and four cubes at rest."""

    def __init__(self) -> None:
        self.world = World()
        self.robot = ROBOTS["kuka"](self.world)
        box = Box(size_m=(0.05, 0.05, 0.05))
        self.bodies = [self.world.add(box, f"cube {i}") for i in range(4)]
        for i, body in enumerate(self.bodies):
            body.place((0.39 + 0.12 * (i // 2), -0.06 + 0.12 * (i % 2), 0.025), 0.4 * i)
        home = self.robot.inverse_kinematics((0.45, 0.0, 0.2), downward(0.0))
        self.robot.teleport(home)
        self.robot.set_opening(1.0)
        self.world.settle()

    def __call__(self) -> None:
        """Step once."""
        self.world.step()


BUDGETS: dict[str, tuple[Budget, Budget | None]] = {
    "close_loop": (Budget("36-60", 2.5, 1.2), None),
    "close_loop/block_picking": (Budget("31", 1.5, 0.8), None),
    "close_loop/object_grasping": (Budget("79", 3.0, 2.0), None),
    "open_loop/block_stacking": (Budget("82", 3.0, 2.0), None),
    "open_loop/house_building_4": (Budget("96", 4.0, 2.4), None),
    "open_loop/box_palletizing": (Budget("374", 6.0, 5.0), None),
    "open_loop/covid_test": (Budget("388", 5.0, 4.0), None),
    "open_loop/bin_packing": (Budget("181", 7.0, 4.5), None),
    "open_loop/object_grasping": (Budget("2650", 15.0, 10.0), Budget("2210", 40.0, 25.0)),
}
"""Budgets of a step and a reset by task, or by control for tasks that are not listed.

They and the reference's durations are for two idle cores of a Xeon with AMX.
"""


def _expert_actions(task: str, episodes: int) -> list[list[Tensor]]:
    """Return the actions of the expert's first episodes."""
    env = make(task, seed=SEED, expert=True)
    played: list[list[Tensor]] = []
    for _ in range(episodes):
        state, actions = env.reset(), []
        while not actions or not state[keys.DONE]:
            actions.append(state[keys.EXPERT_ACTION].clone())
            state = env.step(state.set(keys.ACTION, actions[-1]))[keys.NEXT]
        played.append(actions)
    env.close()
    return played


@measurement("simulation/step", over=lambda: zip(list_tasks()))
def step_and_reset(bench: Bench, task: str) -> list[Row]:
    """Times of steps and resets of a task under the expert's actions.

    The actions are computed before the measurement; the same seed gives the same episodes.
    """
    unit = SimulationUnit()
    env = make(task, seed=SEED)
    steps, resets, units, physics = [], [], [], []
    episodes = _expert_actions(task, bench.repeats)
    for number in bench.rounds():
        units += [seconds(unit) for _ in range(5)]
        start = time.perf_counter()
        state = env.reset()
        resets.append(time.perf_counter() - start)
        for action in episodes[number]:
            state[keys.ACTION] = action
            before = env.scene.world.steps
            start = time.perf_counter()
            result = env.step(state)
            steps.append(time.perf_counter() - start)
            physics.append(env.scene.world.steps - before)
            units.append(seconds(unit))
            state = result[keys.NEXT]
    size = env.observation_spec[keys.PIXELS].shape[-1]
    env.close()
    unit.world.close()
    of_step, of_reset = BUDGETS.get(task, BUDGETS.get(TASKS[task].control, (None, None)))
    notes = f"{np.mean(physics):.1f} physics steps per action, {len(steps)} actions"
    return [
        timed_row(f"{task}, step, {size} px", "ms", steps, units, of_step, notes),
        timed_row(f"{task}, reset", "ms", resets, units, of_reset),
    ]


@measurement("simulation/physics", over=lambda: zip(list_tasks()))
def physics_share(bench: Bench, task: str) -> list[Row]:
    """Times of steps of a task under the expert's actions, and of their physics alone."""
    unit = SimulationUnit()
    env = make(task, seed=SEED)
    steps, physics, units = [], [], []
    episodes = _expert_actions(task, bench.repeats)
    for number in bench.rounds():
        state = env.reset()
        world = env.scene.world
        taken: list[float] = []

        def timed_step(count: int = 1, taken: list[float] = taken, world: World = world) -> None:
            taken.append(seconds(lambda: World.step(world, count)))

        world.step = timed_step
        for action in episodes[number]:
            state[keys.ACTION] = action
            taken.clear()
            start = time.perf_counter()
            state = env.step(state)[keys.NEXT]
            steps.append(time.perf_counter() - start)
            physics.append(sum(taken))
            units.append(seconds(unit))
        del world.step
    env.close()
    unit.world.close()
    mean_ms = 1e3 * float(np.mean(steps))
    notes = f"{np.sum(physics) / np.sum(steps):.0%} of the mean step of {mean_ms:.2f} ms"
    return [
        timed_row(f"{task}, step", "ms", steps, units),
        timed_row(f"{task}, its physics", "ms", physics, units, notes=notes),
    ]


@measurement("simulation/seeded_reset", over=lambda: zip(list_tasks()))
def seeded_reset(bench: Bench, task: str) -> list[Row]:
    """Times of resets with a seed, which start from the task's initial objects."""
    unit = SimulationUnit()
    env = make(task, seed=SEED)
    resets, units = [], []
    for number in bench.rounds():
        start = time.perf_counter()
        env.reset(seed=number)
        resets.append(time.perf_counter() - start)
        units += [seconds(unit) for _ in range(5)]
    env.close()
    unit.world.close()
    return [timed_row(f"{task}, reset with a seed", "ms", resets, units)]


class _Turn(NamedTuple):
    """One step of each environment."""

    times_s: tuple[float, ...]
    physics: tuple[int, ...]
    """Numbers of physics steps."""
    states: tuple[TensorDictBase, ...]
    unit_s: float
    """Duration of a unit of work."""


def _turns(
    bench: Bench,
    tasks: Sequence[str],
    on_reset: Callable[[Sequence[ManipulationEnv]], None] = lambda _: None,
    settings: Sequence[dict[str, Any]] = ({}, {}),
) -> Iterator[_Turn]:
    """Step one environment of each task in turns under the experts' actions.

    The order of the environments is reversed after each turn.

    Args:
        bench: counts the episodes.
        tasks: of the environments; the shortest episode ends a round.
        on_reset: called with the environments after each reset.
        settings: of each environment.
    """
    with contextlib.ExitStack() as stack:
        unit = SimulationUnit()
        stack.callback(unit.world.close)
        envs = [
            make(task, seed=SEED, **values) for task, values in zip(tasks, settings, strict=True)
        ]
        for env in envs:
            stack.callback(env.close)
        played = {task: _expert_actions(task, bench.repeats) for task in dict.fromkeys(tasks)}
        order = list(range(len(envs)))
        for number in bench.rounds():
            states = [env.reset() for env in envs]
            on_reset(envs)
            for actions in zip(*(played[task][number] for task in tasks), strict=False):
                times, physics = [0.0] * len(envs), [0] * len(envs)
                for i in order:
                    states[i][keys.ACTION] = actions[i]
                    before = envs[i].scene.world.steps
                    start = time.perf_counter()
                    result = envs[i].step(states[i])
                    times[i] = time.perf_counter() - start
                    physics[i] = envs[i].scene.world.steps - before
                    states[i] = result[keys.NEXT]
                order.reverse()
                yield _Turn(tuple(times), tuple(physics), tuple(states), seconds(unit))


def _on_level_ground(task: str) -> str:
    return f"open_loop/{task.rpartition('/')[2]}"


def _tasks_on_slopes() -> list[str]:
    """Return the tasks on slopes of which there is another one on level ground."""
    return [
        task
        for task in list_tasks()
        if task.startswith(("ramp/", "bump/")) and _on_level_ground(task) in TASKS
    ]


@measurement("simulation/terrain", over=lambda: zip(_tasks_on_slopes()))
def step_on_slopes(bench: Bench, task: str) -> list[Row]:
    """Times of steps on ramps or bumps, and in turns those of the same task on level ground."""
    turns = list(_turns(bench, (task, _on_level_ground(task))))
    units = [turn.unit_s for turn in turns]
    on_slopes, level = zip(*(turn.times_s for turn in turns), strict=True)
    steps, level_steps = np.mean([turn.physics for turn in turns], axis=0)
    ratio = statistics.median(on_slopes) / statistics.median(level)
    notes = f"{ratio:.2f} times that on level ground, {steps:.1f} physics steps per action"
    level_notes = f"{level_steps:.1f} physics steps per action"
    return [
        timed_row(f"{task}, step", "ms", on_slopes, units, notes=notes),
        timed_row(f"{task}, on level ground", "ms", level, units, notes=level_notes),
    ]


@measurement("simulation/slip_test", over=lambda: zip(SLIP_TASKS))
def slip_test(bench: Bench, task: str) -> list[Row]:
    """Times of steps with and without the test whether a held body slips, in turns.

    The measurement ends when a body slips, since the states then differ.
    """

    def leave_out_second(envs: Sequence[ManipulationEnv]) -> None:
        controller = envs[1].scene.controller
        controller.limits = replace(controller.limits, max_slip_m=math.inf)

    times, units = [], []
    for turn in _turns(bench, (task, task), leave_out_second):
        times.append(turn.times_s)
        units.append(turn.unit_s)
        if not torch.equal(*(state[keys.PIXELS] for state in turn.states)):
            break
    return [
        timed_row(f"{task}, step {name} the slip test", "ms", values, units)
        for name, values in zip(("with", "without"), zip(*times, strict=True), strict=True)
    ]


@measurement("simulation/expert", over=lambda: zip(list_tasks()))
def expert_action(bench: Bench, task: str) -> list[Row]:
    """Times of steps with and without the expert's next action, in turns."""
    turns = list(_turns(bench, (task, task), settings=({"expert": True}, {})))
    units = [turn.unit_s for turn in turns]
    steps, plain = zip(*(turn.times_s for turn in turns), strict=True)
    notes = f"the action takes {1e3 * (statistics.mean(steps) - statistics.mean(plain)):.2f} ms"
    return [
        timed_row(f"{task}, step with the expert's action", "ms", steps, units, notes=notes),
        timed_row(f"{task}, step without it", "ms", plain, units),
    ]


@measurement("simulation/depth_image")
def depth_image(bench: Bench) -> list[Row]:
    """Times of an image of four cubes at 128 x 128: compiled, NumPy and PyBullet."""
    unit = SimulationUnit()
    center, side_m, pixels = (0.45, 0.0), 0.45, 128
    camera, plain = HeightCamera(unit.bodies), NumpyHeightCamera(unit.bodies)
    # the camera does not draw an unchanged image again
    centers = itertools.cycle([center, (center[0] + side_m / pixels, center[1])])
    view, projection = _looking_down(center, side_m)

    def tiny_renderer() -> tuple:
        return pybullet.getCameraImage(
            pixels,
            pixels,
            view,
            projection,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=unit.world.client,
        )

    heights = camera.heightmap(center, side_m, pixels)
    np.testing.assert_allclose(plain.heightmap(center, side_m, pixels), heights, atol=1e-12)
    times = bench.time_against(
        {"unit": unit},
        {
            "compiled": lambda: camera.heightmap(next(centers), side_m, pixels),
            "NumPy": lambda: plain.heightmap(center, side_m, pixels),
            "TinyRenderer, arm and floor visible": tiny_renderer,
        },
        repeats=10,
    )
    units = times.pop("unit")
    cubes = [body.id for body in unit.bodies]
    pybullet.removeBody(unit.robot.id, physicsClientId=unit.world.client)  # the arm occludes cubes
    drawn = np.isin(np.reshape(tiny_renderer()[4], (pixels, pixels)), cubes)
    off = int((drawn != (heights > 0)).sum())
    unit.world.close()
    notes = {
        "NumPy": "equal to the compiled one within 1e-12 m",
        "TinyRenderer, arm and floor visible": (
            f"{off} pixels differ at the edges of {int((heights > 0).sum())}"
        ),
    }
    return [
        timed_row(f"depth image, 128 px, {name}", "ms", values, units, notes=notes.get(name, ""))
        for name, values in times.items()
    ]


def _looking_down(center_m: tuple[float, float], side_m: float) -> tuple[list, list]:
    """Return PyBullet's matrices of an orthographic view from above, rows along +x."""
    x, y = center_m
    view = pybullet.computeViewMatrix((x, y, CAMERA_M), (x, y, 0.0), (-1.0, 0.0, 0.0))
    near, far = 0.1, 2 * CAMERA_M
    projection = np.diag([2 / side_m, 2 / side_m, -2 / (far - near), 1.0])
    projection[2, 3] = -(far + near) / (far - near)
    return view, projection.T.reshape(-1).tolist()
