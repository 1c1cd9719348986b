"""Contacts and distances between bodies, read from PyBullet.

Contacts are those of the last physics step or collision detection; distances are as of now.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import pybullet

from ba_torchrl.sim.geometry import Vector

CONTACT_M = 5e-4
"""Bodies closer than this touch; PyBullet already lists pairs that are millimetres apart."""
VERTICAL_COSINE = 0.6
"""A contact bears from above or below if its normal is within 53 degrees of the vertical."""


class Contact(NamedTuple):
    """A point at which a body touches another, or is about to.

    The fields are those of PyBullet's contact points, in their order.
    """

    flag: int
    body_id: int
    other_id: int
    link: int
    """Of the body; -1 is its base."""
    other_link: int
    position: Vector
    """On the body, metres."""
    other_position: Vector
    """On the other body."""
    normal: Vector
    """Unit vector on the other body, towards the body."""
    distance_m: float
    """Negative where they overlap."""
    force_n: float
    """Normal force in the last step; 0 for distances."""
    friction_1_n: float
    friction_direction_1: Vector
    friction_2_n: float
    friction_direction_2: Vector

    @property
    def is_vertical(self) -> bool:
        """Whether it bears from above or below."""
        return abs(self.normal[2]) > VERTICAL_COSINE


def contacts(client: int, body_id: int, other_id: int = -1) -> list[Contact]:
    """Return the contacts of a body.

    Args:
        client: PyBullet's client id.
        body_id: PyBullet's id of the body.
        other_id: of the other body; contacts with all bodies if not given.
    """
    points = pybullet.getContactPoints(body_id, other_id, physicsClientId=client)
    return [Contact._make(point) for point in points]


def outer_contacts(client: int, *body_ids: int) -> list[Contact]:
    """Return the contacts of a group of bodies, without those between two of them.

    A body's contacts with itself, such as those of two fingers, count.

    Args:
        client: PyBullet's client id.
        body_ids: PyBullet's ids of the bodies, such as a robot and what it holds.
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
    """Return the points at which two bodies are nearest to each other, as of now.

    Args:
        client: PyBullet's client id.
        body_id: PyBullet's id of a body or robot.
        other_id: of another.
        up_to_m: pairs of links that are farther apart are left out.
        link: of the first body; all of them if not given.
    """
    links = {} if link is None else {"linkIndexA": link}
    points = pybullet.getClosestPoints(body_id, other_id, up_to_m, physicsClientId=client, **links)
    return [Contact._make(point) for point in points]


def gap_m(client: int, body_id: int, other_id: int, up_to_m: float = 0.1) -> float:
    """Return the distance between two bodies, as of now.

    Args:
        client: PyBullet's client id.
        body_id: PyBullet's id of a body or robot.
        other_id: of another.
        up_to_m: farther is reported as infinite; negative distances are depths of penetration.
    """
    points = nearest_points(client, body_id, other_id, up_to_m)
    return min((point.distance_m for point in points), default=math.inf)


def is_any_within(contacts: Iterable[Contact], margin_m: float = CONTACT_M) -> bool:
    """Whether any of some contacts is closer than a margin."""
    return any(contact.distance_m < margin_m for contact in contacts)


def bearing_force_n(contacts: Iterable[Contact]) -> float:
    """Return the sum of the normal forces from above and below."""
    return sum(contact.force_n for contact in contacts if contact.is_vertical)


def lateral_force_n(contacts: Iterable[Contact]) -> float:
    """Return the sum of the other normal forces."""
    return sum(contact.force_n for contact in contacts if not contact.is_vertical)
