"""Body: a rigid body of a world, and measurements of its surface at its current pose."""

from __future__ import annotations

import math
from functools import cached_property
from typing import NoReturn

import numpy as np
import pybullet

from ba_torchrl.sim.contacts import contacts, is_any_within
from ba_torchrl.sim.geometry import (
    PlanarFrame,
    Pose,
    Quaternion,
    Vector,
    bullet_compose,
    quaternion_tilt,
    yaw_quaternion,
)
from ba_torchrl.sim.shapes import Shape

_ASLEEP = pybullet.ACTIVATION_STATE_ENABLE_SLEEPING | pybullet.ACTIVATION_STATE_SLEEP
_AWAKE = pybullet.ACTIVATION_STATE_DISABLE_SLEEPING | pybullet.ACTIVATION_STATE_WAKE_UP


def set_asleep(client: int, body_id: int, is_asleep: bool) -> None:
    """Set whether a body is simulated, from the end of the next physics step on.

    A sleeping body is simulated again as soon as a moving one touches it; one that is not asleep
    never sleeps. No saved state contains this.
    """
    state = _ASLEEP if is_asleep else _AWAKE
    pybullet.changeDynamics(body_id, -1, activationState=state, physicsClientId=client)


Interval = tuple[float, float]
"""Lower and upper end."""
MAX_FRAMES = 256
"""Number of horizontal frames in which the extents of a surface are kept."""


class Body:
    """A rigid body in a PyBullet client."""

    _surface: _Surface | None = None
    """The surface at the pose at which it was last measured."""
    _fixed_pose: Pose | None = None
    """The pose while it cannot change, see `World.fixed_poses`; None otherwise."""
    is_inactive = False
    """Whether the body is not in the scene; see `set_inactive`."""
    has_slept = False
    """Whether the body was ever inactive."""
    links: tuple[int, ...] = (-1,)
    """PyBullet's indices of its links; -1 is the base."""

    def __init__(self, client: int, shape: Shape, name: str) -> None:
        self.client = client
        self.shape = shape
        self.name = name
        self.is_hidden = False
        """Whether cameras and `World.is_still` ignore the body."""
        # PyBullet reports and sets the pose of the centre of mass
        self._center = Pose(shape.center_of_mass_m) if any(shape.center_of_mass_m) else None
        self._from_center = None if self._center is None else self._center.inverse()
        self.id = pybullet.createMultiBody(
            baseMass=shape.mass_kg,
            baseCollisionShapeIndex=shape.create_collision(client),
            baseVisualShapeIndex=shape.create_visual(client),
            basePosition=(0.0, 0.0, -shape.bounds_m[0][2]),
            baseInertialFramePosition=shape.center_of_mass_m,
            physicsClientId=client,
        )
        self._set_material()

    def __repr__(self) -> str:
        return f"Body({self.name!r})"

    def __reduce__(self) -> NoReturn:
        raise TypeError(f"{self!r} cannot be copied without its world: copy the environment")

    def _set_material(self) -> None:
        for link in self.links:
            pybullet.changeDynamics(
                self.id,
                link,
                lateralFriction=self.shape.friction,
                frictionAnchor=1,  # prevents slow sliding of held and stacked bodies
                physicsClientId=self.client,
            )
        margin_m = self.shape.collision_margin_m
        if -1 in self.links and margin_m is not None:
            pybullet.changeDynamics(
                self.id, -1, collisionMargin=margin_m, physicsClientId=self.client
            )

    @property
    def is_static(self) -> bool:
        """Whether the body never moves."""
        return self.shape.mass_kg == 0

    @property
    def is_free(self) -> bool:
        """Whether the body moves freely in six dimensions, so that a gripper can lift it."""
        return not self.is_static

    @property
    def pose(self) -> Pose:
        """Pose of the frame of the geometry in the world."""
        return self._read_pose() if self._fixed_pose is None else self._fixed_pose

    def _read_pose(self) -> Pose:
        pose = Pose(*pybullet.getBasePositionAndOrientation(self.id, physicsClientId=self.client))
        return pose if self._from_center is None else bullet_compose(pose, self._from_center)

    def _check_can_move(self) -> None:
        if self._fixed_pose is not None:
            raise RuntimeError(f"{self.name} cannot move here: its pose is fixed")

    def fix_pose(self, is_fixed: bool) -> None:
        """Read the pose once and return it until this is called with False."""
        self._fixed_pose = self._read_pose() if is_fixed else None

    @property
    def position(self) -> Vector:
        """Position of the frame of the geometry, metres."""
        return self.pose.position

    @property
    def yaw_rad(self) -> float:
        """Heading of the body's x axis in the horizontal plane."""
        return self.pose.yaw_rad

    @property
    def tilt_rad(self) -> float:
        """Angle between the body's z axis and the vertical."""
        return quaternion_tilt(self.pose.orientation)

    def place(self, position: Vector, yaw_rad: float = 0.0) -> None:
        """Teleport the frame of the geometry to an upright pose, with zero velocity."""
        self.set_pose(position, yaw_quaternion(yaw_rad))

    def set_pose(self, position: Vector, orientation: Quaternion) -> None:
        """Teleport the frame of the geometry to a pose, with zero velocity."""
        self._check_can_move()
        if self._center is not None:
            position, orientation = bullet_compose(Pose(position, orientation), self._center)
        pybullet.resetBasePositionAndOrientation(
            self.id, position, orientation, physicsClientId=self.client
        )
        pybullet.resetBaseVelocity(
            self.id, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=self.client
        )

    def is_still(self, speed_m_s: float, spin_rad_s: float) -> bool:
        """Whether the L1 norms of the linear and angular velocities are within limits."""
        v, w = pybullet.getBaseVelocity(self.id, physicsClientId=self.client)
        return (
            abs(v[0]) + abs(v[1]) + abs(v[2]) <= speed_m_s
            and abs(w[0]) + abs(w[1]) + abs(w[2]) <= spin_rad_s
        )

    def set_inactive(self, is_inactive: bool) -> None:
        """Set whether the body is out of the scene: hidden, and in Bullet's sleeping state.

        The caller places it where nothing touches it.
        """
        self.is_hidden = self.is_inactive = is_inactive
        self.has_slept |= is_inactive
        self.apply_activity()

    def apply_activity(self) -> None:
        """Let the engine not simulate the body while it is inactive."""
        if self.has_slept and not self.is_static:
            set_asleep(self.client, self.id, self.is_inactive)

    def touches(self, other: Body) -> bool:
        """Whether the two bodies were in contact in the last physics step."""
        points = contacts(self.client, self.id, other.id)
        return is_any_within(point for point in points if point.link in self.links)

    def bounding_box(self) -> tuple[Vector, Vector]:
        """Return the lower and upper corner of the axis-aligned bounding box, metres.

        It contains the surface exactly; PyBullet's is larger by up to 35 mm for a rotated body.
        """
        vertices = world_vertices(self)
        return tuple(vertices.min(axis=0).tolist()), tuple(vertices.max(axis=0).tolist())


class _Surface:
    """A body's visual surface at one pose."""

    def __init__(self, body: Body, pose: Pose) -> None:
        self.pose = pose
        self.vertices = pose.apply(body.shape.vertices)
        self.vertices.flags.writeable = False
        self._planar_extents: dict[PlanarFrame, tuple[Interval, Interval]] = {}

    @cached_property
    def vertical_extent(self) -> tuple[float, float]:
        heights = self.vertices[:, 2]
        return float(heights.min()), float(heights.max())

    def planar_extents(self, frame: PlanarFrame) -> tuple[Interval, Interval]:
        found = self._planar_extents.get(frame)
        if found is None:
            if len(self._planar_extents) >= MAX_FRAMES:  # the surface of a static body stays
                self._planar_extents.clear()
            x, y = frame.to_local(self.vertices[:, 0], self.vertices[:, 1])
            found = (float(x.min()), float(x.max())), (float(y.min()), float(y.max()))
            self._planar_extents[frame] = found
        return found


def _surface(body: Body) -> _Surface:
    """Return the surface at the present pose."""
    pose = body.pose
    if body._surface is None or body._surface.pose != pose:
        body._surface = _Surface(body, pose)
    return body._surface


def world_vertices(body: Body) -> np.ndarray:
    """Return the vertices of a body's visual surface in the world frame, [V, 3] metres."""
    return _surface(body).vertices


def vertical_extent(body: Body) -> tuple[float, float]:
    """Return the heights of a body's lowest and highest vertex in the world frame, metres."""
    return _surface(body).vertical_extent


def planar_extents(body: Body, frame: PlanarFrame) -> tuple[Interval, Interval]:
    """Return the intervals that a body's vertices cover along the axes of a horizontal frame.

    They are the lower and upper end along the x axis, and along the y axis, metres.
    """
    return _surface(body).planar_extents(frame)


def footprint_radius_m(body: Body) -> float:
    """Return the largest horizontal distance of an upright body's bounding box from its origin."""
    low, high = body.shape.bounds_m
    return math.hypot(*(max(-a, b) for a, b in zip(low[:2], high[:2], strict=True)))
