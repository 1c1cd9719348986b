"""Random layouts of objects and containers that do not overlap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.core.errors import PlacementError
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.manipulation.footprints import Rectangle, gap_m

LAYOUTS = 10
"""Random layouts before a `PlacementError`."""
TRIES = 100
"""Random poses of each object in a layout."""


class Footprint(NamedTuple):
    """The space that an upright object needs on the floor, metres."""

    half_x: float
    """Half its extent along its own x axis."""
    half_y: float
    """Half its extent along its own y axis."""
    hand_x: float = 0.0
    """Half the extent along x of the hand that grasps it, which stays free; 0 for none."""
    hand_y: float = 0.0
    """Half the extent along y of the hand that grasps it."""
    margin_m: float = 0.005
    """Gap to other objects."""


def scatter(
    task: Task,
    rng: np.random.Generator,
    footprints: Sequence[Footprint],
    fixed: Sequence[Rectangle] = (),
    clear_of: Rectangle | None = None,
) -> list[tuple[tuple[float, float], float]]:
    """Return random points and yaws inside the workspace at which footprints do not overlap.

    Args:
        task: gives the workspace, the robot, and whether orientations are random.
        footprints: footprint of each object.
        fixed: outlines of bodies that are in the scene already.
        clear_of: outline of a tall body, which the hand that grasps an object must not overlap.

    Raises:
        PlacementError: no layout was found.
    """
    for _ in range(LAYOUTS):
        placed: list[tuple[Rectangle, Rectangle | None]] = [(other, None) for other in fixed]
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
                    for other, other_hand in placed
                ):
                    break
            else:
                break
            placed.append((body, hand))
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
    """Return a rectangle with a random centre and yaw, its corners inside the workspace.

    On a terrain with a fixed place for it, it is there.

    Args:
        task: gives the workspace, and whether orientations are random.
        half_x: half its extent along its x axis.
        half_y: half its extent along its y axis.
        fixed_yaw_rad: its yaw with fixed orientations.

    Raises:
        PlacementError: the workspace is too small.
    """
    frame = task.terrain.goal_frame
    if frame is not None:
        return Rectangle(*frame, half_x, half_y)
    yaw = fixed_yaw_rad + task.random_yaw(rng, 2 * math.pi)
    ex, ey = Rectangle(0.0, 0.0, yaw, half_x, half_y).extents_m(0.0)
    point = []
    for (low, high), extent in (
        (task.settings.workspace.x, ex),
        (task.settings.workspace.y, ey),
    ):
        if low + extent > high - extent:
            raise PlacementError(
                f"a container of {2 * half_x:.3g} m by {2 * half_y:.3g} m does not fit: enlarge "
                "`workspace` or lower `object_scale_range`"
            )
        point.append(float(rng.uniform(low + extent, high - extent)))
    return Rectangle(*point, yaw, half_x, half_y)
