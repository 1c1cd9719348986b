"""Fingerprints of the episodes of the tasks and of the actions of their experts.

    python -m tests.tasks.fingerprints    # records what has a new version

`fingerprints.json` holds, by task, its versions, the actions of an episode, and by robot sums over
the states: of the scene, the images and the results, and of the expert's action. There are two
episodes: one of the recorded actions, with which the robot `ROBOT` reaches the goal, and one of
random actions. The expert acts in none of them. Parameters are the defaults, but for `PARAMETERS`.

Contacts amplify the rounding errors of a processor. When a fingerprint is recorded, the episodes
are therefore played again with noise on initial positions and actions. A sum ends before the first
state at which it, or after the first state that of the positions, differs by more than `SPREAD`;
that of the results ends where positions differ by `DIVERGED_M`.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from tensordict import TensorDictBase

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.sim.bodies import Body
from ba_torchrl.tasks.base import TASKS, versions_of

FILE = Path(__file__).with_name("fingerprints.json")
COMMAND = "python -m tests.tasks.fingerprints"
ROBOT, ROBOTS = "kuka", ("kuka", "panda", "ur5", "ur5_robotiq")
SEED, RANDOM_STEPS = 3, 4
PARAMETERS = {f"{name}_loop/object_grasping": {"num_objects": 1} for name in ("close", "open")}
"""By task, since poses in a heap depend on the processor."""
NOISE, ACTION_NOISE, NOISY_PLAYS = 1e-8, 1e-6, 8
"""Standard deviations in metres or radians, and the number of plays with noise."""
TOLERANCE, IMAGE_TOLERANCE = 3e-3, 1e-4
"""Of a sum, in metres, radians or shares of one; of a sum of the means of images."""
SPREAD = 0.25
"""As a share of the tolerance."""
DIVERGED_M = 5e-3

Rows = dict[str, list[list[float]]]
"""By quantity, its numbers in each state."""
Fingerprint = dict[str, list[float]]
"""By quantity: number of states, and the sums of its numbers over these states."""


def play(
    task: str,
    robot: str,
    actions: list[list[float]] | None,
    noise: np.random.Generator | None = None,
) -> tuple[Rows, Rows, list[list[float]]]:
    """Play both episodes.

    Args:
        task: id of the task.
        robot: name of the robot.
        actions: of the first episode; those of the expert if None.
        noise: of positions and actions.

    Returns:
        The quantities of the task, those of the expert, and the actions of the first episode.
    """
    found: tuple[Rows, Rows] = defaultdict(list), defaultdict(list)
    env = ba_torchrl.make(task, robot=robot, seed=SEED, expert=True, **PARAMETERS.get(task, {}))
    try:
        space = env.action_spec.space
        low, high = (bound.numpy().astype(np.float64) for bound in (space.low, space.high))
        if robot == ROBOT:
            sizes = [size for image in env.images.values() for size in image.shape]
            numbers = [env.max_steps, TASKS[task].num_objects, *sizes, *low, *high]
            found[0]["parameters"].append(numbers)
        taken = _play_episode(env, 0, actions, found, noise)
        shares = np.random.default_rng(SEED).uniform(size=(RANDOM_STEPS, len(low)))
        _play_episode(env, 1, (low + shares * (high - low)).tolist(), found, noise)
    finally:
        env.close()
    return *found, taken


def _play_episode(
    env: BulletArmEnv,
    number: int,
    actions: list[list[float]] | None,
    found: tuple[Rows, Rows],
    noise: np.random.Generator | None,
) -> list[list[float]]:
    """Play an episode, append the numbers of its states, and return its actions."""
    placements: list[list[float]] = []
    set_pose = Body.set_pose

    def note_pose(self: Body, position: Any, orientation: Any) -> None:
        placements.append([*position, *orientation])
        if noise is not None:  # not on z, as a body on the floor would fall or bounce
            position = (*noise.normal(position[:2], NOISE), position[2])
        set_pose(self, position, orientation)

    with mock.patch.object(Body, "set_pose", note_pose):
        state = env.reset(seed=SEED + number)
    if placements:
        found[0][f"{number} placements"] = placements
    taken: list[list[float]] = []
    while True:
        for name, values in _quantities(env, state).items():
            found[0][f"{number} {name}"].append(values)
        if state[keys.DONE]:
            return taken
        found[1][f"{number} action"].append(state[keys.EXPERT_ACTION].tolist())
        if actions is not None and len(taken) == len(actions):
            return taken
        chosen = state[keys.EXPERT_ACTION].tolist() if actions is None else actions[len(taken)]
        taken.append([round(value, 4) for value in chosen])
        action = torch.tensor(taken[-1], dtype=torch.float32)
        if noise is not None:
            action += torch.from_numpy(noise.normal(0, ACTION_NOISE, len(action))).float()
            space = env.action_spec.space
            action = action.clamp(space.low, space.high)
        state = env.step(state.clone().set(keys.ACTION, action))[keys.NEXT]


def _quantities(env: BulletArmEnv, state: TensorDictBase) -> dict[str, list[float]]:
    """Return the quantities of a state; of the objects, sums weighted by their numbers."""
    task, robot = env.scene.task, env.scene.robot
    positions, yaws_rad = zip(*task.landmarks, strict=True)
    weights = 1 + np.arange(len(positions)) / len(positions)
    quantities = {
        "positions": weights @ np.array(positions),
        "yaws": weights @ np.array([(math.cos(yaw), math.sin(yaw)) for yaw in yaws_rad]),
        "gripper": [*robot.tool_pose()[0], robot.opening()],
        "results": [*task.conditions().values(), state[keys.DONE]],
    }
    if type(task).progress is not ba_torchrl.tasks.base.Task.progress:
        quantities["progress"] = [task.progress()]
    for key in env.images:
        image = state[key].double().numpy().mean(axis=0)
        place = np.linspace(-1, 1, len(image))
        quantities[f"image {key}"] = [
            image.mean(),
            (image * place).mean(),
            (image.T * place).mean(),
        ]
    return {name: [float(value) for value in values] for name, values in quantities.items()}


def _counts(here: Rows, noisy: Sequence[Rows]) -> dict[str, int]:
    """Return by quantity how many of the first rows agree in noisy episodes."""
    return {
        name: min(
            _agreeing(np.cumsum(values, axis=0), np.cumsum(other[name], axis=0), _tolerance(name))
            for other in noisy
        )
        for name, values in here.items()
    }


def _agreeing(here: np.ndarray, there: np.ndarray, tolerance: float) -> int:
    """Return the number of first rows that differ by no more than `SPREAD` of a tolerance."""
    shared = min(len(here), len(there))
    differs = np.abs(here[:shared] - there[:shared]).max(axis=1) > SPREAD * tolerance
    return int(differs.argmax()) if differs.any() else shared


def _tolerance(name: str) -> float:
    return IMAGE_TOLERANCE if "image" in name else TOLERANCE


def _fingerprints(
    found: tuple[Rows, Rows], noisy: Sequence[tuple[Rows, Rows]]
) -> dict[str, Fingerprint]:
    """Return the sums over the states in which noisy episodes agree, of the task and the expert."""
    counts = _counts(found[0], [each[0] for each in noisy])
    counts |= _counts(found[1], [each[1] for each in noisy])
    for name in counts:
        number, _, quantity = name.partition(" ")
        positions = f"{number} positions"
        if quantity == "results":
            scenes = [
                np.array(rows[positions]) for rows in (found[0], *(each[0] for each in noisy))
            ]
            diverged = [_agreeing(scenes[0], scene, DIVERGED_M / SPREAD) for scene in scenes[1:]]
            counts[name] = min(counts[name], *diverged)
        elif quantity and quantity != "placements":  # whose rows are no states
            counts[name] = min(counts[name], max(1, counts[positions]))
    return {
        part: {
            name: [counts[name], *np.sum(values[: counts[name]], axis=0).round(5).tolist()]
            for name, values in rows.items()
            if counts[name]
        }
        for part, rows in zip(("task", "expert"), found, strict=True)
    }


def _differences(recorded: Fingerprint, rows: Rows) -> list[str]:
    """Return how episodes differ from a fingerprint, a text for each quantity."""
    found = []
    for name, (count, *sums) in recorded.items():
        here = rows.get(name, [])[: int(count)]
        if len(here) < count or len(here[0]) != len(sums):
            found.append(f"{name}: {len(here)} states with other numbers, {count} are recorded")
            continue
        now = np.sum(here, axis=0)
        if (np.abs(now - sums) > _tolerance(name)).any():
            found.append(f"{name}: sum over {count} states {sums} -> {now.round(5).tolist()}")
    return found


def is_recorded(task: str, entry: Mapping[str, Any] | None) -> bool:
    """Return whether an entry of `FILE`, None if there is none, is of a task's versions."""
    return entry is not None and versions_of(task) == (
        entry["task_version"],
        entry["expert_version"],
    )


def changes(task: str, entry: Mapping[str, Any], robots: Sequence[str] | None = None) -> list[str]:
    """Return for each robot how a task or its expert differs from an entry, and what to do."""
    found = []
    for robot in robots or ROBOTS:
        of_task, of_expert, _ = play(task, robot, entry["actions"])
        if differences := _differences(entry[robot]["task"], of_task):
            what, name = f"the episodes of {task}", "version"
        elif differences := _differences(entry[robot]["expert"], of_expert):
            what, name = f"the actions of the expert of {task}", "expert_version"
        else:
            continue
        found.append(
            f"{what} with {robot} changed. If they should, raise {TASKS[task].__name__}.{name} "
            f"and run `{COMMAND}`\n  " + "\n  ".join(differences)
        )
    return found


def record(task: str, entry: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return a new entry; what is of the task remains if its version does.

    Raises:
        ValueError: the episodes of a task with the same version changed.
    """
    versions = versions_of(task)
    is_same_task = entry is not None and entry["task_version"] == versions.task
    actions = entry["actions"] if is_same_task else play(task, ROBOT, None)[2]
    out = {"task_version": versions.task, "expert_version": versions.expert, "actions": actions}
    for robot in ROBOTS:
        of_task, of_expert, _ = play(task, robot, actions)
        noisy = [
            play(task, robot, actions, np.random.default_rng(seed)) for seed in range(NOISY_PLAYS)
        ]
        out[robot] = _fingerprints((of_task, of_expert), [(each[0], each[1]) for each in noisy])
        if is_same_task:
            out[robot]["task"] = entry[robot]["task"]
            if differences := _differences(out[robot]["task"], of_task):
                raise ValueError(
                    f"not only the expert of {task} changed, also its episodes with {robot}: raise "
                    f"{TASKS[task].__name__}.version\n  " + "\n  ".join(differences)
                )
    return out


def read() -> dict[str, Any]:
    """Return the recorded entries by task."""
    return json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}


def write(entries: Mapping[str, Any]) -> None:
    """Write the entries, an episode or a fingerprint per line."""
    text = json.dumps(entries, separators=(",", ":"))
    for mark in (
        '"task_version"',
        '"actions"',
        '"task":',
        '"expert":',
        *map('"{}"'.format, ROBOTS),
    ):
        text = text.replace(mark, f"\n{mark}")
    FILE.write_text(text.replace('}},"', '}},\n"') + "\n", encoding="utf-8")


def built_in() -> list[str]:
    """Return the tasks of the package."""
    return [task for task in TASKS if TASKS.plugin_module(task) is None]


def main() -> None:
    """Record every task that has a new version."""
    torch.set_num_threads(1)
    recorded = read()
    entries = {task: recorded.get(task) for task in built_in()}
    for task, entry in entries.items():
        if not is_recorded(task, entry):
            entries[task] = record(task, entry)
            print(f"{task}: {versions_of(task)}")
    write(entries)


if __name__ == "__main__":
    main()
