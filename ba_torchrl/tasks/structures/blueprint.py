"""Structures as data: a `Blueprint` says which piece rests on which.

It lists slots from the bottom up. Each names the kind of piece that fills it and the slots that it
rests on: none for the ground, one, or two for a bridge. What follows from it, whether the structure
stands and what to do next, is worked out by `ba_torchrl.tasks.structures.planner.StructurePlanner`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import Vector, quaternion_matrix
from ba_torchrl.sim.shapes import Shape
from ba_torchrl.tasks.workspace import Spot

UPRIGHT_RAD = math.pi / 9
"""A piece that leans less than this is upright."""
_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def _both(*axes: Vector) -> tuple[Vector, ...]:
    return tuple(tuple(sign * x for x in axis) for axis in axes for sign in (1.0, -1.0))


@dataclass(frozen=True)
class Piece:
    """A kind of piece, and the body that is loaded for it.

    Args:
        kind: the name that bodies are matched by.
        yaw_period_rad: turned by this much it looks the same.
        grasp_yaws_rad: yaws of a gripper whose fingers close on it, relative to its own; each
            stands for its reverse too.
        up: directions of its frame that may point up.
        stays_upright: whether it ends the episode if it tips over.
        shape: of the body; None where the bodies are given otherwise.
        spot: space that it needs at the start of an episode; None stands for its own circle.
        variants: pieces of this kind, of which every episode draws as many as there are slots.
    """

    kind: str
    yaw_period_rad: float = 2 * math.pi
    grasp_yaws_rad: tuple[float, ...] = (0.0,)
    up: tuple[Vector, ...] = (_Z,)
    stays_upright: bool = False
    shape: Shape | None = None
    spot: Spot | None = None
    variants: tuple[Piece, ...] = ()

    def tilt_rad(self, body: Body) -> float:
        """Return the angle by which a body is off the nearest way in which it may lie."""
        down = quaternion_matrix(body.pose.orientation)[2]
        cosine = max(sum(d * u for d, u in zip(down, up, strict=True)) for up in self.up)
        return math.acos(min(max(cosine, -1.0), 1.0))

    def yaw_rad(self, body: Body) -> float:
        """Return a body's heading, whichever of its sides is up."""
        x_axis, y_axis, _ = zip(*quaternion_matrix(body.pose.orientation), strict=True)
        if abs(y_axis[2]) <= abs(x_axis[2]):  # the y axis is closer to horizontal than the x axis
            return math.atan2(y_axis[1], y_axis[0]) - math.pi / 2
        return math.atan2(x_axis[1], x_axis[0])

    def grasp_yaws(self, body: Body) -> list[float]:
        """Return the gripper's yaws at which the fingers close on a body."""
        heading = self.yaw_rad(body)
        return [heading + yaw for yaw in self.grasp_yaws_rad]


CUBE = Piece("cube", math.pi / 2, (0.0, math.pi / 2), _both(_X, _Y, _Z))
CUBOID = Piece("cuboid", math.pi, (0.0,), _both(_X, _Z))
"""A long box, its length along y."""
ROOF = Piece("roof", math.pi, (0.0,), stays_upright=True)
"""A long gable, its ridge along y, held by the eaves."""
TRIANGLE = Piece("triangle", math.pi, (math.pi / 2,), stays_upright=True)
"""A short gable, its ridge along y. Fingers hold it best by its ends, which are upright."""
CYLINDER_SIDES = 16
"""Of the polygon that stands for the circle."""
CYLINDER = Piece(
    "cylinder",
    2 * math.pi / CYLINDER_SIDES,
    tuple(2 * math.pi * i / CYLINDER_SIDES for i in range(CYLINDER_SIDES // 2)),
    _both(_Z),
    stays_upright=True,
)
"""An upright cylinder, two of its sides across x. On its side it would roll away."""


class Span(NamedTuple):
    """Distance between the centres of the two pieces under a bridge."""

    least_m: float
    aim_m: float
    most_m: float
    gap_m: float | None = None
    """Where given, an expert aims for this gap between their surfaces, along the line between them,
    and the limits are of that gap too."""


@dataclass(frozen=True)
class Slot:
    """A place in a structure.

    Args:
        piece: what fills it.
        on: the slots it rests on, each listed before this one: none for the ground; two make it
            a bridge, which lies across the line between them.
        over: slots above whose middle it must be; those it rests on unless given.
        span: for a bridge, how far apart its two supports stand. If these share a support of
            their own, they stand along its y axis, about its middle.
        inherits_yaw: whether an expert aligns it with what it rests on; the goal does not ask.
        stays_free: whether nothing may lie on it that the blueprint does not put there.
    """

    piece: Piece
    on: tuple[int, ...] = ()
    over: tuple[int, ...] = ()
    span: Span | None = None
    inherits_yaw: bool = True
    stays_free: bool = False


@dataclass(frozen=True)
class Blueprint:
    """A structure: slots from the bottom up.

    Raises:
        ValueError: a slot rests on a later one or on more than two, or a bridge has no span.
    """

    slots: tuple[Slot, ...]

    def __post_init__(self) -> None:
        for number, slot in enumerate(self.slots):
            if len(set(slot.on)) != len(slot.on) or len(slot.on) > 2:
                raise ValueError(f"slot {number} must rest on the ground, one or two others")
            if any(not 0 <= other < number for other in (*slot.on, *slot.over)):
                raise ValueError(f"slot {number} must be listed after what it rests on")
            if (len(slot.on) == 2) != (slot.span is not None):
                raise ValueError(f"slot {number}: a span is for slots that rest on two others")
            if slot.span is not None and self.slots[slot.on[0]].on != self.slots[slot.on[1]].on:
                raise ValueError(f"slot {number}: its two supports must rest on the same")

    @property
    def optimal_steps(self) -> int:
        """Picks and places needed if every piece lies on the ground, none where it belongs.

        Of all that hang together one piece stays, and the rest is built about it.
        """
        groups = [{number} for number in range(len(self.slots))]
        for number, slot in enumerate(self.slots):
            for other in slot.on:
                joined = next(group for group in groups if other in group)
                if number not in joined:
                    mine = next(group for group in groups if number in group)
                    groups.remove(mine)
                    joined |= mine
        return 2 * (len(self.slots) - len(groups))

    def bridge_on(self, number: int) -> int | None:
        """Return the bridge that rests on a slot and on another, if there is one."""
        for bridge, slot in enumerate(self.slots):
            if len(slot.on) == 2 and number in slot.on:
                return bridge
        return None

    def partner(self, number: int) -> int | None:
        """Return the slot that carries the same bridge."""
        bridge = self.bridge_on(number)
        if bridge is None:
            return None
        first, second = self.slots[bridge].on
        return second if number == first else first


def tower(*pieces: Piece) -> Blueprint:
    """Return pieces on top of each other, the lowest first; nothing may lie on the last."""
    return Blueprint(
        tuple(
            Slot(piece, on=(i - 1,) if i else (), stays_free=i == len(pieces) - 1)
            for i, piece in enumerate(pieces)
        )
    )
