"""Bridges: pieces on two supports, and where the two supports are placed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.tasks.manipulation.footprints import Rectangle, gap_m, outline
from ba_torchrl.tasks.structures.blueprint import Piece, Slot
from ba_torchrl.tasks.structures.free_space import (
    PlacementArea,
    extent_along_m,
    placement_deficit_m,
)
from ba_torchrl.tasks.structures.moves import Grasps

BEARINGS = 16
"""Directions per half turn in which sites beside a piece are compared."""
SITE_POINTS = 7
"""Points along a bridge that represent the footprint of a structure."""
LEVEL_M = 1e-3
"""Tolerance of the height at which a bridge rests on a piece beside its supports."""


class SupportSite(NamedTuple):
    """Where on the ground the second support of a bridge is placed."""

    xy: tuple[float, float]
    yaw_rad: float | None
    """Yaw of the support; None if any is allowed."""
    deficit_m: float
    """Free space that it and the bridge lack there."""


def bridge_yaw_rad(supports: Sequence[Body]) -> float:
    """Return the yaw of a bridge, perpendicular to the line between its supports."""
    (ax, ay, _), (bx, by, _) = (support.position for support in supports)
    return math.atan2(by - ay, bx - ax) - math.pi / 2


def beside_supports(bridge: Body, supports: Sequence[Body], others: Sequence[Body]) -> list[Body]:
    """Return the bodies beside two supports on which a bridge would rest, too.

    Args:
        supports: its supports; a piece with fewer than two is no bridge.
        others: bodies that are not part of the structure.
    """
    if len(supports) != 2:
        return []
    (ax, ay, _), (bx, by, _) = (support.position for support in supports)
    low, high = bridge.shape.bounds_m
    half_x, half_y = ((b - a) / 2 for a, b in zip(low[:2], high[:2], strict=True))
    yaw = bridge_yaw_rad(supports)
    covered = Rectangle((ax + bx) / 2, (ay + by) / 2, yaw, half_x, half_y)
    top = max(vertical_extent(support)[1] for support in supports) - LEVEL_M
    return [
        other
        for other in others
        if other is not bridge
        and vertical_extent(other)[1] > top
        and gap_m(covered, outline(other)) < 0
    ]


def point_on_support(
    body: Body, support: Body, support_yaw_rad: float, neighbor: Body | None, bridge: Slot
) -> tuple[float, float]:
    """Return where on a long support one of the two pieces under a bridge is placed.

    Args:
        support_yaw_rad: yaw of the support, which is longest along y.
        neighbor: the other piece, if it is on the support already.
    """
    yaw = support_yaw_rad + math.pi / 2
    ux, uy = math.cos(yaw), math.sin(yaw)
    sx, sy, _ = support.position
    x, y, _ = (body if neighbor is None else neighbor).position
    along = (x - sx) * ux + (y - sy) * uy
    if neighbor is None:
        offset = math.copysign(bridge.span.aim_m / 2, along)
    else:
        offset = along - math.copysign(bridge.span.aim_m, along)
    return sx + offset * ux, sy + offset * uy


def site_beside(
    body: Body,
    neighbor: Body,
    bridge: Slot,
    *,
    pieces: Mapping[Body, Piece],
    rest: Sequence[Body],
    area: PlacementArea,
    grasps: Grasps,
) -> SupportSite:
    """Return where on the ground a body is placed so that it and a neighbour support a bridge.

    Args:
        rest: the pieces that remain to be picked.
    """
    piece = pieces[body]
    x, y, _ = body.position
    center = np.array(neighbor.position[:2])
    if area.line_yaw_rad is None:
        start = math.atan2(y - center[1], x - center[0])
        bearings = start + math.pi / BEARINGS * np.arange(2 * BEARINGS)
    else:
        bearings = area.line_yaw_rad + np.array([0.0, math.pi])
    directions = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    radii = np.full(len(directions), bridge.span.aim_m)
    yaw = None
    if bridge.span.gap_m is not None:
        # the side that faces the neighbour is one on which the fingers do not close
        side = piece.grasp_yaws_rad[0] + math.pi / 2
        cos, sin = math.cos(side), math.sin(side)
        far = (body.shape.vertices[:, :2] @ [cos, sin]).max()
        near = (body.shape.vertices[:, :2] @ [-cos, -sin]).max()
        radii = extent_along_m(neighbor, directions) + max(far, near) + bridge.span.gap_m
        yaw = -side
    sites = center + radii[:, None] * directions
    others = [other for other in pieces if other is not body and other is not neighbor]
    deficits = placement_deficit_m(sites, body, others, area, in_structure=True)
    lengths = (
        np.ptp(other.shape.vertices[:, 1])
        for other, other_piece in pieces.items()
        if other_piece.kind == bridge.piece.kind
    )
    length = max(lengths, default=0.0)
    along = radii[:, None] / 2 + length / 2 * np.linspace(-1.0, 1.0, SITE_POINTS)
    footprints = center + along[:, :, None] * directions[:, None]
    deficits = deficits + grasps.site_deficit_m(footprints, rest)
    distances = np.hypot(sites[:, 0] - x, sites[:, 1] - y)
    best = int(np.lexsort((radii + distances, deficits.round(6)))[0])
    target_yaw = None if yaw is None else float(yaw + bearings[best])
    return SupportSite(tuple(sites[best].tolist()), target_yaw, float(deficits[best]))
