"""What actions of other programs say against the observations beside them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ba_torchrl.core import keys
from ba_torchrl.core.actions import PICK, CloseLoopActions
from ba_torchrl.core.vectors import downward_yaws
from ba_torchrl.demonstrations.formats.base import Arrays
from ba_torchrl.envs.settings import ResolvedEnv

_LEAST_STEPS = 4
"""Steps from which a share of them is told."""
_LEAST_HELD = 2
"""The same of steps in which an object remains held, of which an episode has few."""
_CONTRADICTING = 0.8
"""Share of steps with a contradiction from which it is told; random actions have a half."""
_EXPLAINED = 0.25
"""Part of the motion that actions explain, from which it counts as theirs. Blocked and clipped
motions leave the rest."""
_MOTION_M, _MOTION_RAD = 1e-3, 1e-2
"""Root mean square of a motion, from which it is compared."""


def contradictions(episodes: Sequence[Arrays], resolved: ResolvedEnv) -> Iterator[str]:
    """Yield sentences on actions that contradict the gripper, the motion or the workspace.

    Args:
        episodes: with the entries of the environment, and T or T + 1 rows of observations.
        resolved: the environment.
    """
    actions = resolved.actions
    if isinstance(actions, CloseLoopActions):
        yield from _of_gripper(episodes, actions)
        yield from _of_motion(episodes, resolved, actions)
    elif "p" in actions.components:
        yield from _of_primitive(episodes, actions.components.index("p"))


def _of_gripper(episodes: Sequence[Arrays], actions: CloseLoopActions) -> Iterator[str]:
    opens = []
    for arrays in episodes:
        held = arrays[keys.HOLDING][:, 0]
        command = arrays[keys.ACTION][: len(held) - 1, actions.sequence.index("p")]
        opens += (command > 0)[held[:-1] & held[1:][: len(command)]].tolist()
    if len(opens) >= _LEAST_HELD and np.mean(opens) >= _CONTRADICTING:
        yield (
            f"in {np.mean(opens):.0%} of the steps in which an object remains held, the action "
            "opens the gripper; is p 1 for open and -1 for closed, and holding 1 for held?"
        )


def _of_primitive(episodes: Sequence[Arrays], column: int) -> Iterator[str]:
    wrong: list[bool] = []
    for arrays in episodes:
        picks = np.round(arrays[keys.ACTION][:, column]) == PICK
        wrong += (picks == arrays[keys.HOLDING][: len(picks), 0]).tolist()
    if len(wrong) >= _LEAST_STEPS and np.mean(wrong) >= _CONTRADICTING:
        yield (
            f"{np.mean(wrong):.0%} of the actions pick while an object is held, or place without "
            "one; is p 0 for a pick and 1 for a place, and holding 1 for held?"
        )


def _of_motion(
    episodes: Sequence[Arrays], resolved: ResolvedEnv, actions: CloseLoopActions
) -> Iterator[str]:
    columns = [actions.sequence.index(axis) for axis in "xyz"]
    steps_m = [arrays[keys.ACTION][:, columns] * actions.dpos_m for arrays in episodes]
    space = resolved.workspace
    if (positions := _positions(episodes, resolved)) is None:
        widths = [high - low for low, high in (space.x, space.y, space.z)]
        far = [(abs(each.sum(0)) > widths).any() for each in steps_m]
        if len(far) > 1 and np.mean(far) > 0.5:
            yield (
                f"in {np.mean(far):.0%} of the episodes the displacements (x, y, z times dpos) add "
                "up to more than the workspace; are the actions absolute positions?"
            )
        return
    found, wanted = _moves(positions, steps_m)
    if (explained := _explained(found, wanted, _MOTION_M)) < _EXPLAINED:
        yield (
            f"the actions (x, y, z times dpos) explain {max(explained, 0):.0%} of the gripper's "
            "motion; are they absolute positions, or of another order, frame or scale?"
        )
    if keys.PROPRIO not in episodes[0]:
        return
    yaws = [downward_yaws(arrays[keys.PROPRIO][:, 3:7]) for arrays in episodes]
    turn = actions.drot_rad if actions.has_yaw else 0.0
    if turn:
        column = actions.sequence.index("r")
        turns = [arrays[keys.ACTION][:, column] * turn for arrays in episodes]
        found, wanted = _moves(yaws, turns)
        found = (found + math.pi / 2) % math.pi - math.pi / 2  # a half turn swaps the fingers
        wanted = (wanted + math.pi / 2) % math.pi - math.pi / 2
        explained = _explained(found, wanted, _MOTION_RAD)
        if explained < _EXPLAINED:
            yield (
                f"the actions (r times drot) explain {max(explained, 0):.0%} of the gripper's "
                "turns; check their sign and scale, and the order x, y, z, w of proprio"
            )
    if all(abs(each[0]) > math.pi / 2 for each in yaws):
        yield (
            "in every episode the gripper begins turned by more than 90 degrees, where the "
            "environment begins at 0; is the quaternion of proprio in the order x, y, z, w?"
        )


def _positions(episodes: Sequence[Arrays], resolved: ResolvedEnv) -> list[np.ndarray] | None:
    """Return the gripper's positions in each episode, metres; None if they are not observed."""
    if keys.PROPRIO in episodes[0]:
        return [arrays[keys.PROPRIO][:, :3] for arrays in episodes]
    if keys.OBSERVATION not in episodes[0]:
        return None
    space = resolved.workspace
    low, high = np.array([space.x, space.y, space.z]).T
    return [low + (arrays[keys.OBSERVATION][:, 1:4] + 1) / 2 * (high - low) for arrays in episodes]


def _moves(
    places: Sequence[np.ndarray], steps: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the changes of places and the commanded ones, of steps with a place after them."""
    found = [np.diff(place, axis=0) for place in places]
    pairs = zip(found, steps, strict=True)
    return np.concatenate(found), np.concatenate([each[: len(moves)] for moves, each in pairs])


def _explained(found: np.ndarray, wanted: np.ndarray, least: float) -> float:
    """Return the part of changes that commanded ones explain; 1 if neither is as large as
    ``least`` in the mean, or there are too few."""
    if len(found) < _LEAST_STEPS:
        return 1.0
    largest = max(float(np.mean(found**2)), float(np.mean(wanted**2)))
    if largest < least**2:
        return 1.0
    return 1 - float(np.mean((found - wanted) ** 2)) / max(float(np.mean(found**2)), least**2)
