"""Structures as data: a `Blueprint` is a support graph, which states which piece rests on which.

It lists slots from the bottom up. Each slot names the kind of piece that fills it and the slots
that support it: none for the ground, one, or two for a bridge. `SlotAssigner` matches bodies to
slots and tests whether the structure stands, and `next_move` returns the next move.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Vector, quaternion_matrix
from ba_torchrl.sim.shapes import Shape
from ba_torchrl.tasks.workspace import Spacing

UPRIGHT_RAD = math.pi / 9
"""Largest tilt of an upright piece."""


@dataclass(frozen=True)
class Piece:
    """A kind of piece, and the shape that is loaded for it.

    Args:
        kind: noun by which bodies are matched to slots, and which instructions contain.
        yaw_period_rad: angle of its rotational symmetry about the vertical.
        grasp_yaws_rad: yaws of the gripper at which the fingers close on it, relative to its own
            yaw; a yaw half a turn away is equivalent.
        up: directions in its own frame that point up when it lies on one of its valid sides.
        stays_upright: whether the episode ends when it tips over.
        shape: shape of the body; None if the bodies are loaded elsewhere.
        spacing: space around it at the start of an episode; None for its bounding circle.
        variants: pieces of this kind; every episode draws as many of them as there are slots.
    """

    kind: str
    yaw_period_rad: float = 2 * math.pi
    grasp_yaws_rad: tuple[float, ...] = (0.0,)
    up: tuple[Vector, ...] = ((0.0, 0.0, 1.0),)
    stays_upright: bool = False
    shape: Shape | None = None
    spacing: Spacing | None = None
    variants: tuple[Piece, ...] = ()

    def tilt_rad(self, body: Body) -> float:
        """Return the least angle between the vertical and a direction of `up`."""
        down = quaternion_matrix(body.pose.orientation)[2]
        cosine = max(sum(d * u for d, u in zip(down, up, strict=True)) for up in self.up)
        return math.acos(min(max(cosine, -1.0), 1.0))

    def yaw_rad(self, body: Body) -> float:
        """Return the yaw of a body; it may lie on any of its sides."""
        x_axis, y_axis, _ = zip(*quaternion_matrix(body.pose.orientation), strict=True)
        if abs(y_axis[2]) <= abs(x_axis[2]):  # the y axis is closer to horizontal than the x axis
            return math.atan2(y_axis[1], y_axis[0]) - math.pi / 2
        return math.atan2(x_axis[1], x_axis[0])

    def grasp_yaws(self, body: Body) -> list[float]:
        """Return the yaws of the gripper at which the fingers close on a body."""
        yaw = self.yaw_rad(body)
        return [yaw + grasp_yaw for grasp_yaw in self.grasp_yaws_rad]


class Span(NamedTuple):
    """Distance between the centres of the two supports of a bridge."""

    least_m: float
    aim_m: float
    """Distance at which the expert places them."""
    most_m: float
    gap_m: float | None = None
    """If given, the gap between their surfaces, along the line between their centres, at which the
    expert places them; `least_m` and `most_m` then bound this gap as well."""


@dataclass(frozen=True)
class Slot:
    """A position in a structure.

    Args:
        piece: kind of piece that fills it.
        on: numbers of the slots that support it, all listed before this one. Empty: it stands on
            the ground. Two: it is a bridge, perpendicular to the line between its supports.
        centered_over: numbers of the slots over whose mean position its centre lies; `on` if empty.
        span: distance of the supports of a bridge. Supports that share a support of their own stand
            along its y axis, on both sides of its centre.
        inherits_yaw: whether the expert aligns it with its support; the goal does not require it.
        stays_clear: whether only pieces that the blueprint places on it may rest on it.
    """

    piece: Piece
    on: tuple[int, ...] = ()
    centered_over: tuple[int, ...] = ()
    span: Span | None = None
    inherits_yaw: bool = True
    stays_clear: bool = False


@dataclass(frozen=True)
class Blueprint:
    """A structure: its slots from the bottom up."""

    slots: tuple[Slot, ...]

    def __post_init__(self) -> None:
        for number, slot in enumerate(self.slots):
            if len(set(slot.on)) != len(slot.on) or len(slot.on) > 2:
                raise ValueError(f"slot {number} must rest on the ground, one or two others")
            if any(not 0 <= other < number for other in (*slot.on, *slot.centered_over)):
                raise ValueError(f"slot {number} must be listed after its supports")
            if (len(slot.on) == 2) != (slot.span is not None):
                raise ValueError(f"slot {number}: a span is for slots that rest on two others")
            if slot.span is not None and self.slots[slot.on[0]].on != self.slots[slot.on[1]].on:
                raise ValueError(f"slot {number}: its two supports must rest on the same slots")

    def bridge_on(self, number: int) -> tuple[Slot | None, int | None]:
        """Return the bridge on a slot, and the slot number of the bridge's other support.

        Both are None if the slot supports no bridge.
        """
        for slot in self.slots:
            if len(slot.on) == 2 and number in slot.on:
                return slot, sum(slot.on) - number
        return None, None


def tower(*pieces: Piece) -> Blueprint:
    """Return a stack of pieces, the lowest first; nothing may rest on the last piece."""
    return Blueprint(
        tuple(
            Slot(piece, on=(i - 1,) if i else (), stays_clear=i == len(pieces) - 1)
            for i, piece in enumerate(pieces)
        )
    )
