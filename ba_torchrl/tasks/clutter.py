"""Clutter: a pool of objects, some of which lie in a heap while the others are out of the way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ba_torchrl.sim.bodies import Body, Quaternion, Solid
from ba_torchrl.sim.robots.base import Robot, downward
from ba_torchrl.sim.world import World

DROP_Z_M = 0.2
DROP_INTERVAL_S = 0.15
"""Time between objects: each falls 11 cm, out of the next one's way."""
SETTLE_S = 4.0
LOW_DROP_M = 5e-3
APART_M = 5e-3
LAYOUTS = 20
TRIES = 50
DROP_ATTEMPTS = 3
"""Heaps tried until one comes to rest inside its area; round objects may roll for long."""

ASIDE_Z_M = 1e6
ASIDE_SPACING_M = 0.3
ASIDE_X_M = 5.0
RETREAT_Z_M = (0.55, 0.5, 0.45, 0.4, 0.35)
"""Heights to which the arm retreats while objects fall: the first that is in its reach."""


class Clutter:
    """Loads every shape of a set once, and shows some of them at a time.

    Objects out of use fall freely, each in its own column, for seven simulated minutes at least.
    That costs less than anything that rests, and nothing about a body ever changes but its pose:
    changed masses or collision filters would give it a new place in PyBullet's lists, and a
    restored state another future.

    Args:
        world: not sealed yet.
        shapes: to draw from; repeated as often as ``count`` needs.
        names: of the shapes.
        count: most objects at a time.
    """

    def __init__(
        self, world: World, shapes: Sequence[Solid], names: Sequence[str], count: int
    ) -> None:
        self.world = world
        copies = -(-count // len(shapes))
        self.bodies = [
            world.add(shape, f"{name} {copy + 1}" if copies > 1 else name)
            for copy in range(copies)
            for shape, name in zip(shapes, names, strict=True)
        ]
        """The whole pool."""
        self.present: list[Body] = []
        """Those in use."""
        for body in self.bodies:
            self._put_aside(body)

    def put_aside(self, body: Body) -> None:
        """Take an object out of use."""
        self.present.remove(body)
        self._put_aside(body)

    def drop(
        self,
        rng: np.random.Generator,
        count: int,
        *,
        center_xy: tuple[float, float],
        spread_m: float,
        surface_z_m: float,
        random_orientation: bool,
        robot: Robot,
    ) -> None:
        """Let new objects fall one by one and come to rest; the arm is out of the way meanwhile.

        Args:
            rng: draws objects and poses.
            count: of objects.
            center_xy: middle of the area, metres.
            spread_m: objects start this far from the middle at most, along x and along y.
            surface_z_m: height of what they fall on.
            random_orientation: any orientation; else upright and with yaw 0. If there is room,
                these objects come down apart and from close above, so that they stay so.
            robot: to keep away.
        """
        joints = robot.joints
        heights = (robot.inverse_kinematics((*center_xy, z), downward(0.0)) for z in RETREAT_Z_M)
        robot.teleport(next((found for found in heights if found is not None), joints))
        pause = round(DROP_INTERVAL_S / self.world.physics.time_step_s)
        for body in self.bodies:
            self._put_aside(body)
        for _ in range(DROP_ATTEMPTS):
            for body in self.present:
                self._put_aside(body)
            chosen = rng.choice(len(self.bodies), size=count, replace=False)
            self.present = [self.bodies[i] for i in chosen]
            points = rng.uniform(-spread_m, spread_m, (count, 2))
            apart = None if random_orientation else _apart(rng, self.present, spread_m)
            for i, body in enumerate(self.present):
                x, y = center_xy + (points[i] if apart is None else apart[i])
                if apart is None:
                    z = DROP_Z_M
                else:
                    z = surface_z_m + LOW_DROP_M - body.shape.bounds_m[0][2]
                turn = _random_turn(rng) if random_orientation else (0.0, 0.0, 0.0, 1.0)
                body.move_to((x, y, z), turn)
                body.is_hidden = False
                self.world.step(pause)
            if self.world.settle(round(SETTLE_S / self.world.physics.time_step_s)):
                break
        robot.teleport(joints)

    def get_state(self) -> tuple[int, ...]:
        """Return which objects are in use."""
        return tuple(self.bodies.index(body) for body in self.present)

    def set_state(self, state: tuple[int, ...]) -> None:
        """Take up what `get_state` returned; their poses are the world's to restore."""
        self.present = [self.bodies[i] for i in state]
        for body in self.bodies:
            body.is_hidden = body not in self.present

    def _put_aside(self, body: Body) -> None:
        row, column = divmod(self.bodies.index(body), 10)
        x, y = ASIDE_X_M + ASIDE_SPACING_M * column, ASIDE_SPACING_M * row
        body.place((x, y, ASIDE_Z_M))
        body.is_hidden = True


def _apart(rng: np.random.Generator, bodies: Sequence[Body], spread_m: float) -> np.ndarray | None:
    """Return random points [N, 2] of a square about zero at which upright bodies do not touch.

    Returns:
        None if no room was found for all of them.
    """
    bounds = np.array([np.array(body.shape.bounds_m)[:, :2] for body in bodies])
    for _ in range(LAYOUTS):
        placed: list[np.ndarray] = []
        for low_high in bounds:
            for _ in range(TRIES):
                low, high = low_high + rng.uniform(-spread_m, spread_m, 2)
                others = np.array([other[:2] for other in placed]).reshape(-1, 2, 2)
                gaps = np.maximum(low - others[:, 1], others[:, 0] - high)
                if (gaps.max(axis=1) > APART_M).all():
                    placed.append(np.array([low, high]))
                    break
            else:
                break
        else:
            return np.array(placed)[:, 0] - bounds[:, 0]
    return None


def _random_turn(rng: np.random.Generator) -> Quaternion:
    """Return an orientation uniform over all there are."""
    quaternion = rng.normal(size=4)
    return tuple((quaternion / np.linalg.norm(quaternion)).tolist())
