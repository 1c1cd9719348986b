"""Terrain: the support surface that the objects of a task stand on.

Every question about heights of the ground is answered here: where an object stands, whether a body
is on the ground, how low the tool may go. A terrain may be drawn anew in every episode.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import Matrix, Pose, yaw_quaternion
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.workspace import Area, Spot, Workspace


class Terrain(ABC):
    """A support surface within a workspace.

    Args:
        world: not sealed yet; the terrain loads its own bodies.
        workspace: bounds of the task.
    """

    def __init__(self, world: World, workspace: Workspace) -> None:
        self.world = world
        self.workspace = workspace

    # -- for subclasses ----------------------------------------------------------------------

    @property
    @abstractmethod
    def support_ids(self) -> frozenset[int]:
        """PyBullet ids of the bodies that form the surface."""

    @abstractmethod
    def height_m(self, xy: tuple[float, float]) -> float:
        """Return the height of the surface at a point, metres."""

    @abstractmethod
    def surface_pose(self, xy: tuple[float, float], yaw_rad: float = 0.0) -> Pose:
        """Return the pose of a frame on the surface, whose z axis is the surface normal.

        Args:
            xy: point of the workspace, metres.
            yaw_rad: heading of the frame's x axis in the horizontal plane.
        """

    @property
    def spawn_area(self) -> Area:
        """Where objects start."""
        return Area(self.workspace.x, self.workspace.y)

    @property
    def build_area(self) -> Area:
        """Where experts put objects down and build."""
        return Area(self.workspace.x, self.workspace.y)

    def can_hold(self, xy: tuple[float, float], radius_m: float) -> bool:
        """Whether an object of a radius lies flush on the surface if it is centred at a point."""
        return True

    def initialize_episode(self, rng: np.random.Generator) -> None:  # noqa: B027 -- optional
        """Draw the terrain of an episode, before the objects are placed."""

    def get_state(self) -> Any:
        """Return what `initialize_episode` has drawn."""
        return None

    def set_state(self, state: Any) -> None:  # noqa: B027 -- flat ones have none
        """Restore what `get_state` returned; the poses of bodies are restored by the world."""

    # -- placements --------------------------------------------------------------------------

    def random_point(self, rng: np.random.Generator, padding_m: float) -> tuple[float, float]:
        """Return a uniform point that keeps half of ``padding_m`` from the border.

        Raises:
            PlacementError: the area is too small.
        """
        return self.random_points(rng, [Spot(padding_m, 0.0)])[0]

    def random_points(
        self, rng: np.random.Generator, spots: list[Spot]
    ) -> list[tuple[float, float]]:
        """Return uniform points of the spawn area, apart from each other.

        Raises:
            PlacementError: no layout was found.
        """
        return self.spawn_area.random_points(
            rng, spots, lambda point, spot: self.can_hold(point, spot.padding_m / 2)
        )

    def stand(self, body: Body, xy: tuple[float, float], yaw_rad: float) -> None:
        """Put a body at rest on the surface, upright with respect to it."""
        offset = Pose((0.0, 0.0, -body.shape.bounds_m[0][2]))
        body.set_pose(*self.surface_pose(xy, yaw_rad).compose(offset))

    # -- heights -----------------------------------------------------------------------------

    def gap_below_m(self, body: Body) -> float:
        """Return how far the lowest point of a body is above the surface under its origin."""
        return vertical_extent(body)[0] - self.height_m(body.position[:2])

    def lowest_tool_m(
        self,
        gripper: Gripper,
        xy: tuple[float, float],
        rotation: Matrix | None = None,
        opening: float = 1.0,
    ) -> float:
        """Return the least height of the tool at which the fingers close above the surface.

        Args:
            gripper: the gripper.
            xy: of the tool, metres.
            rotation: of the tool; if None, it points down.
            opening: of the gripper before it closes, 0 to 1.
        """
        return self.height_m(xy) + gripper.lowest_tool_m(rotation, opening)


class Flat(Terrain):
    """The world's floor, level at height zero."""

    @property
    def support_ids(self) -> frozenset[int]:
        """The floor."""
        return frozenset((self.world.floor,))

    def height_m(self, xy: tuple[float, float]) -> float:
        """Return zero."""
        return 0.0

    def surface_pose(self, xy: tuple[float, float], yaw_rad: float = 0.0) -> Pose:
        """Return the pose of an upright frame on the floor."""
        return Pose((*xy, self.height_m(xy)), yaw_quaternion(yaw_rad))
