"""Contacts and distances between bodies, read from PyBullet.

Contact points come from the last physics step or collision detection. Distances are computed
for the current poses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import pybullet

from ba_torchrl.sim.geometry import Vector

CONTACT_DISTANCE_M = 5e-4
"""Bodies closer than this are in contact; PyBullet also lists pairs that are millimetres apart."""
VERTICAL_COSINE = 0.6
"""A contact is vertical if its normal is within 53 degrees of the vertical."""
CANCELLED = 0.1
"""Share of a sum of forces below which they cancel out."""


class Contact(NamedTuple):
    """A contact point, or a pair of closest points, of two bodies.

    The fields are PyBullet's, in the same order.
    """

    flag: int
    body_id: int
    other_id: int
    link: int
    """Link of the body; -1 is the base."""
    other_link: int
    position: Vector
    """Point on the body, metres."""
    other_position: Vector
    """Point on the other body, metres."""
    normal: Vector
    """Unit contact normal, from the other body towards the body."""
    distance_m: float
    """Negative where the bodies penetrate each other."""
    force_n: float
    """Normal force in the last step; 0 for closest points."""
    friction_1_n: float
    friction_direction_1: Vector
    friction_2_n: float
    friction_direction_2: Vector

    @property
    def is_vertical(self) -> bool:
        """Whether the contact normal is close to the vertical."""
        return abs(self.normal[2]) > VERTICAL_COSINE


def contacts(client: int, body_id: int, other_id: int = -1) -> list[Contact]:
    """Return the contact points of a body, by default with all bodies."""
    points = pybullet.getContactPoints(body_id, other_id, physicsClientId=client)
    return [Contact._make(point) for point in points]


def outer_contacts(client: int, *body_ids: int) -> list[Contact]:
    """Return the contact points of a group of bodies, except those between two bodies of the group.

    The group is, for example, a robot and the body that it holds. Contacts of a body with itself,
    such as those between two fingers, are included.
    """
    return [
        contact
        for body_id in body_ids
        for contact in contacts(client, body_id)
        if contact.other_id == body_id or contact.other_id not in body_ids
    ]


def nearest_points(
    client: int, body_id: int, other_id: int, up_to_m: float, link: int | None = None
) -> list[Contact]:
    """Return the closest points of two bodies or robots at their current poses.

    Pairs of links that are farther apart than ``up_to_m`` are omitted. ``link`` is one of the first
    body; None stands for all of them.
    """
    links = {} if link is None else {"linkIndexA": link}
    points = pybullet.getClosestPoints(body_id, other_id, up_to_m, physicsClientId=client, **links)
    return [Contact._make(point) for point in points]


def gap_m(client: int, body_id: int, other_id: int, up_to_m: float = 0.1) -> float:
    """Return the distance between two bodies or robots at their current poses.

    It is infinity beyond ``up_to_m``, and negative if the bodies penetrate each other.
    """
    points = nearest_points(client, body_id, other_id, up_to_m)
    return min((point.distance_m for point in points), default=math.inf)


def is_any_within(contacts: Iterable[Contact], margin_m: float = CONTACT_DISTANCE_M) -> bool:
    """Whether the distance of any of the contacts is less than a margin."""
    return any(contact.distance_m < margin_m for contact in contacts)


def vertical_force_n(contacts: Iterable[Contact]) -> float:
    """Return the sum of the normal forces of the vertical contacts."""
    return sum(contact.force_n for contact in contacts if contact.is_vertical)


def lateral_force_n(contacts: Iterable[Contact]) -> float:
    """Return the sum of the normal forces of the contacts that are not vertical."""
    return sum(contact.force_n for contact in contacts if not contact.is_vertical)


def lateral_direction(contacts: Iterable[Contact]) -> tuple[float, float]:
    """Return the horizontal direction of the lateral forces on the bodies, a unit vector.

    It is (0, 0) if the forces cancel out.
    """
    lateral = [contact for contact in contacts if not contact.is_vertical]
    x, y = (sum(c.force_n * c.normal[axis] for c in lateral) for axis in (0, 1))
    norm = math.hypot(x, y)
    total = sum(contact.force_n for contact in lateral)
    return (x / norm, y / norm) if norm > CANCELLED * total else (0.0, 0.0)


def vertical_direction(contacts: Iterable[Contact]) -> float:
    """Return the sign of the sum of the vertical forces on the bodies: 1 upwards, -1 downwards."""
    force = sum(c.force_n * c.normal[2] for c in contacts if c.is_vertical)
    return math.copysign(1.0, force)
