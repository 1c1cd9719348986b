"""Rectangles in the plane: where containers, bodies and fingers are, and whether they meet."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.errors import PlacementError
from ba_torchrl.sim.bodies import Body, world_vertices
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.workspace import Workspace

LAYOUTS = 10
TRIES = 100
"""Random layouts, and places for each thing in one, before giving up."""
WIDTH_YAWS = 12
"""Directions in which an object is measured."""
AS_NARROW_M = 5e-4
FINGER_M = (0.02, 0.024)
"""Room of a fingertip: along the line on which it closes, where it is a centimetre or two above
its end, and across."""
TIP_M = 0.009
"""The fingertips end this far below the tool point."""
RELEASE_M = 0.004
"""How far a finger opens to let go."""


class Rectangle(NamedTuple):
    """A rectangle in the plane, metres and radians."""

    x: float
    y: float
    yaw_rad: float
    half_x: float
    """Half its extent along its own x axis."""
    half_y: float

    @property
    def frame(self) -> PlanarFrame:
        """Frame of its centre, x along its first side."""
        return PlanarFrame(self.x, self.y, self.yaw_rad)

    def resized(self, half_x: float, half_y: float) -> Rectangle:
        """Return one of another size about the same centre."""
        return self._replace(half_x=half_x, half_y=half_y)

    def contains(self, points: np.ndarray) -> bool:
        """Whether all points [N, 2 or more] lie in it, whatever their height."""
        along, across = map(np.abs, self.frame.to_local(points[:, 0], points[:, 1]))
        return bool(along.max() <= self.half_x and across.max() <= self.half_y)

    def is_inside(self, workspace: Workspace) -> bool:
        """Whether its corners lie in the workspace's floor area."""
        ex, ey = self._extent(0.0)
        return all(
            low <= center - extent and center + extent <= high
            for center, extent, (low, high) in (
                (self.x, ex, workspace.x),
                (self.y, ey, workspace.y),
            )
        )

    def _extent(self, yaw_rad: float) -> tuple[float, float]:
        """Return half its extents along the axes of a frame with this yaw."""
        cos = abs(math.cos(self.yaw_rad - yaw_rad))
        sin = abs(math.sin(self.yaw_rad - yaw_rad))
        return cos * self.half_x + sin * self.half_y, sin * self.half_x + cos * self.half_y


def gap_m(first: Rectangle, second: Rectangle) -> float:
    """Return how far apart two rectangles are along the sides of either; negative if they overlap.

    It is the distance where a side faces the other, and less than that across corners.
    """
    gap = -math.inf
    for a, b in ((first, second), (second, first)):
        dx, dy = a.frame.to_local(b.x, b.y)
        ex, ey = b._extent(a.yaw_rad)
        gap = max(gap, abs(dx) - a.half_x - ex, abs(dy) - a.half_y - ey)
    return gap


def outline(body: Body, yaw_rad: float | None = None) -> Rectangle:
    """Return the rectangle around a body, as it lies, seen from above.

    Args:
        body: the body.
        yaw_rad: of the rectangle; the body's own unless given.
    """
    yaw = body.yaw_rad if yaw_rad is None else yaw_rad
    return _around(world_vertices(body), yaw)


def narrowest(body: Body, yaw_rad: float | None = None) -> list[Rectangle]:
    """Return the rectangles around a body along whose x axis it is narrowest.

    Args:
        body: the body.
        yaw_rad: measure along this direction only.

    Returns:
        One, or as many as there are directions in which the body is as narrow.
    """
    corners = world_vertices(body)
    if yaw_rad is not None:
        return [_around(corners, yaw_rad)]
    # its own axes first: they fit best
    yaws = [body.yaw_rad + math.pi * i / WIDTH_YAWS for i in range(WIDTH_YAWS)]
    yaws.sort(key=lambda yaw: round((yaw - body.yaw_rad) / (math.pi / 2), 6) % 1 > 0)
    found = [_around(corners, yaw) for yaw in yaws]
    least = min(rectangle.half_x for rectangle in found)
    return [rectangle for rectangle in found if rectangle.half_x <= least + AS_NARROW_M]


def fingers(
    xy: tuple[float, float], yaw_rad: float, half_opening_m: float
) -> tuple[Rectangle, Rectangle]:
    """Return where a gripper's fingers are.

    Args:
        xy: of the tool.
        yaw_rad: of the tool; the fingers open along its x axis.
        half_opening_m: from the tool point to a finger's inner side.
    """
    along, across = FINGER_M
    tool = PlanarFrame(*xy, yaw_rad)
    middle = half_opening_m + along / 2
    left, right = (
        Rectangle(*tool.to_world(side * middle, 0.0), yaw_rad, along / 2, across / 2)
        for side in (-1.0, 1.0)
    )
    return left, right


def finger_gap_m(
    xy: tuple[float, float],
    yaw_rad: float,
    half_opening_m: float,
    others: Iterable[Rectangle],
) -> float:
    """Return the gap between a gripper's fingers and what stands beside them.

    Args:
        xy: of the tool.
        yaw_rad: of the tool.
        half_opening_m: from the tool point to a finger's inner side.
        others: outlines of what is as high as the fingertips.
    """
    hands = fingers(xy, yaw_rad, half_opening_m)
    return min((gap_m(hand, other) for other in others for hand in hands), default=math.inf)


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
                    whole_hand = body.resized(*task.robot.hand_half_m)
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
    ex, ey = Rectangle(0.0, 0.0, yaw, half_x, half_y)._extent(0.0)
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


def _around(corners: np.ndarray, yaw_rad: float) -> Rectangle:
    """Return the rectangle with this yaw around points [N, 3] seen from above."""
    frame = PlanarFrame(0.0, 0.0, yaw_rad)
    along, across = frame.to_local(corners[:, 0], corners[:, 1])
    (x0, x1), (y0, y1) = ((float(values.min()), float(values.max())) for values in (along, across))
    middle = frame.to_world((x0 + x1) / 2, (y0 + y1) / 2)
    return Rectangle(*middle, yaw_rad, (x1 - x0) / 2, (y1 - y0) / 2)
