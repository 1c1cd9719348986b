"""Random layouts of objects and containers that do not overlap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.errors import PlacementError
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.footprints import Rectangle, gap_m

LAYOUTS = 10
TRIES = 100
"""Random layouts, and places for each thing in one, before giving up."""


class Footprint(NamedTuple):
    """The room that an upright object needs on the floor, metres."""

    half_x: float
    """Half its extents."""
    half_y: float
    hand_x: float = 0.0
    """Half the extents of the hand that grasps it at its own yaw; objects keep out of it."""
    hand_y: float = 0.0
    margin_m: float = 0.005
    """Gap to other objects."""


def scatter(
    task: Task,
    rng: np.random.Generator,
    footprints: Sequence[Footprint],
    fixed: Sequence[Rectangle] = (),
    clear_of: Rectangle | None = None,
) -> list[tuple[tuple[float, float], float]]:
    """Return random places and yaws, inside the workspace and apart from each other.

    Args:
        task: its workspace, and whether orientations are random.
        rng: draws them.
        footprints: one for each object.
        fixed: what stands there already.
        clear_of: something tall, which the hand above the fingers must not meet.

    Raises:
        PlacementError: there is no room.
    """
    for _ in range(LAYOUTS):
        taken: list[tuple[Rectangle, Rectangle | None]] = [(other, None) for other in fixed]
        found: list[tuple[tuple[float, float], float]] = []
        for footprint in footprints:
            for _ in range(TRIES):
                xy = task.random_point(rng, 2 * min(footprint.half_x, footprint.half_y))
                yaw = task.random_yaw(rng, 2 * math.pi)
                body = Rectangle(*xy, yaw, footprint.half_x, footprint.half_y)
                hand = (
                    body.resized(footprint.hand_x, footprint.hand_y) if footprint.hand_x else None
                )
                if clear_of is not None:
                    whole_hand = body.resized(*task.robot.hand_half_extents_m)
                    if gap_m(whole_hand, clear_of) < 0:
                        continue
                if body.is_inside(task.settings.workspace) and all(
                    gap_m(body, other) >= footprint.margin_m
                    and (hand is None or gap_m(hand, other) >= 0)
                    and (other_hand is None or gap_m(body, other_hand) >= 0)
                    for other, other_hand in taken
                ):
                    break
            else:
                break
            taken.append((body, hand))
            found.append((xy, yaw))
        else:
            return found
    raise PlacementError(
        f"no room for {len(footprints)} objects apart: enlarge `workspace`, or lower "
        "`num_objects` or `object_scale_range`"
    )


def random_rectangle(
    task: Task, rng: np.random.Generator, half_x: float, half_y: float, fixed_yaw_rad: float = 0.0
) -> Rectangle:
    """Return a rectangle with a random place and yaw, its corners inside the workspace.

    Args:
        task: its workspace, and whether orientations are random.
        rng: draws place and yaw.
        half_x: half its extent along its x axis.
        half_y: half its extent along its y axis.
        fixed_yaw_rad: its yaw where orientations are not random.

    Raises:
        PlacementError: the workspace is too small.
    """
    yaw = fixed_yaw_rad + task.random_yaw(rng, 2 * math.pi)
    ex, ey = Rectangle(0.0, 0.0, yaw, half_x, half_y).extents_m(0.0)
    point = []
    for (low, high), extent in (
        (task.settings.workspace.x, ex),
        (task.settings.workspace.y, ey),
    ):
        if low + extent > high - extent:
            raise PlacementError(
                f"something {2 * half_x:.3g} m by {2 * half_y:.3g} m does not fit: enlarge "
                "`workspace` or lower `object_scale_range`"
            )
        point.append(float(rng.uniform(low + extent, high - extent)))
    return Rectangle(*point, yaw, half_x, half_y)
