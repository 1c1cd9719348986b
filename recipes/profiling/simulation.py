"""Times of steps, resets and images, also as multiples of a step of PyBullet."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pybullet
from torch import Tensor

from ba_torchrl import list_tasks, make
from ba_torchrl.core import keys
from ba_torchrl.sim.geometry import downward
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import TASKS
from profiling.table import Bench, Budget, Row, measurement, seconds, timed_row

SEED = 0
CAMERA_M = 1.0


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


def expert_episodes(task: str, **settings: Any) -> Iterator[list[Tensor]]:
    """Yield the actions of the expert's episodes, which an environment of `SEED` can repeat."""
    with closing(make(task, seed=SEED, expert=True, **settings)) as env:
        while True:
            state, actions = env.reset(), []
            while not actions or not state[keys.DONE]:
                actions.append(state[keys.EXPERT_ACTION].clone())
                state = env.step(state.set(keys.ACTION, actions[-1]))[keys.NEXT]
            yield actions


@measurement("simulation/step", over=lambda: zip(list_tasks()))
def step_and_reset(bench: Bench, task: str) -> list[Row]:
    """Times of steps and resets of a task under the expert's actions.

    The actions are computed before the measurement; the same seed gives the same episodes.
    """
    unit = SimulationUnit()
    env = make(task, seed=SEED)
    steps, resets, units, physics = [], [], [], []
    episodes = list(itertools.islice(expert_episodes(task), bench.repeats))
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
    size = env.config.obs_size
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
    episodes = list(itertools.islice(expert_episodes(task), bench.repeats))
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


@measurement("simulation/expert", over=lambda: zip(list_tasks()))
def expert_action(bench: Bench, task: str) -> list[Row]:
    """Times of steps with and without the expert's next action, in turns.

    The order of the two environments is reversed after each turn.
    """
    unit = SimulationUnit()
    envs = [make(task, seed=SEED, expert=expert) for expert in (True, False)]
    episodes = list(itertools.islice(expert_episodes(task), bench.repeats))
    times: list[list[float]] = [[], []]
    units = []
    for number in bench.rounds():
        states = [env.reset() for env in envs]
        for turn, action in enumerate(episodes[number]):
            for i in (0, 1) if turn % 2 else (1, 0):
                states[i][keys.ACTION] = action
                start = time.perf_counter()
                result = envs[i].step(states[i])
                times[i].append(time.perf_counter() - start)
                states[i] = result[keys.NEXT]
            units.append(seconds(unit))
    for env in envs:
        env.close()
    unit.world.close()
    steps, plain = times
    notes = f"the action takes {1e3 * (statistics.mean(steps) - statistics.mean(plain)):.2f} ms"
    return [
        timed_row(f"{task}, step with the expert's action", "ms", steps, units, notes=notes),
        timed_row(f"{task}, step without it", "ms", plain, units),
    ]


@measurement("simulation/depth_image")
def depth_image(bench: Bench) -> list[Row]:
    """Times of an image of four cubes at 128 x 128, by the compiled kernels and by PyBullet."""
    unit = SimulationUnit()
    center, side_m, pixels = (0.45, 0.0), 0.45, 128
    camera = HeightCamera(unit.bodies)
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

    calls = {
        "compiled": lambda: camera.heightmap(next(centers), side_m, pixels),
        "TinyRenderer, arm and floor visible": tiny_renderer,
    }
    times = bench.time_against({"unit": unit}, calls, repeats=10)
    heights = camera.heightmap(center, side_m, pixels)
    cubes = [body.id for body in unit.bodies]
    pybullet.removeBody(unit.robot.id, physicsClientId=unit.world.client)  # the arm occludes cubes
    drawn = np.isin(np.reshape(tiny_renderer()[4], (pixels, pixels)), cubes)
    off = int((drawn != (heights > 0)).sum())
    unit.world.close()
    differing = f"{off} pixels differ at the edges of {int((heights > 0).sum())}"
    return [
        timed_row(f"depth image, 128 px, {name}", "ms", times[name], times["unit"], notes=notes)
        for name, notes in zip(calls, ("", differing), strict=True)
    ]


def _looking_down(center_m: tuple[float, float], side_m: float) -> tuple[list, list]:
    """Return PyBullet's matrices of an orthographic view from above, rows along +x."""
    x, y = center_m
    view = pybullet.computeViewMatrix((x, y, CAMERA_M), (x, y, 0.0), (-1.0, 0.0, 0.0))
    near, far = 0.1, 2 * CAMERA_M
    projection = np.diag([2 / side_m, 2 / side_m, -2 / (far - near), 1.0])
    projection[2, 3] = -(far + near) / (far - near)
    return view, projection.T.reshape(-1).tolist()
