"""Terrain: the support surface of the objects of a task.

A terrain answers all questions about heights of the ground: where an object stands, whether a body
is on the ground, how low the tool may go. A terrain may change between episodes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import Matrix, PlanarFrame, Pose, yaw_quaternion
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.workspace import Area, Spacing, Workspace, random_points


class Terrain(ABC):
    """A support surface within a workspace.

    Args:
        world: not sealed yet; the terrain loads its own bodies.
    """

    place_words: ClassVar[str] = ""
    """Words that instructions add for the place where structures stand."""

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

    @property
    def base_ids(self) -> frozenset[int]:
        """PyBullet ids of the bodies of the surface on which a structure may stand."""
        return self.support_ids

    @property
    def spawn_area(self) -> Area:
        """The area where objects start."""
        return Area(self.workspace.x, self.workspace.y)

    @property
    def build_area(self) -> Area:
        """The area where experts build structures on the ground."""
        return Area(self.workspace.x, self.workspace.y)

    @property
    def aside_area(self) -> Area:
        """The area where experts place other objects on the ground."""
        return self.build_area

    @property
    def goal_frame(self) -> PlanarFrame | None:
        """Centre and heading of the place where a container stands; None if it stands anywhere."""
        return None

    def surface_pose(self, xy: tuple[float, float], yaw_rad: float = 0.0) -> Pose:
        """Return the pose of a frame on the surface, whose z axis is the surface normal.

        This, `origin_pose`, `gap_below_m` and `lowest_tool_m` assume that the surface is level; one
        with slopes overrides them.

        Args:
            xy: point of the workspace, metres.
            yaw_rad: yaw of the frame's x axis in the horizontal plane.
        """
        return Pose((*xy, self.height_m(xy)), yaw_quaternion(yaw_rad))

    def origin_pose(self, xy: tuple[float, float], rise_m: float, radius_m: float) -> Pose:
        """Return a frame whose z axis is the surface normal, at the origin of an object.

        Args:
            xy: point of the ground below the object, metres.
            rise_m: distance of the origin above the surface, along the normal.
            radius_m: radius of the object, which may cover several faces.
        """
        return self.surface_pose(xy).compose(Pose((0.0, 0.0, rise_m)))

    def uneven_m(self, points: np.ndarray, radius_m: float) -> np.ndarray:
        """Return how uneven the surface is below objects of a radius at points [N, 2], [N] metres.

        Zero where an object is in full contact.
        """
        return np.zeros(len(points))

    def overhang_m(self, points: np.ndarray, radius_m: float) -> np.ndarray:
        """Return a deficit of sites [N, 2] at which a base would leave the build area, [N] metres.

        Zero where the border of the build area is no obstacle.
        """
        return np.zeros(len(points))

    def reserve(self, width_m: float) -> None:  # noqa: B027 -- optional
        """Leave space for a structure in the next episodes.

        Args:
            width_m: largest extent between the fingers of its pieces that stand on the ground.
        """

    def initialize_episode(self, rng: np.random.Generator) -> None:  # noqa: B027 -- optional
        """Draw the random parts of the terrain, before the objects are placed."""

    def get_state(self) -> Any:
        """Return the random parts that `initialize_episode` has drawn."""
        return None

    def set_state(self, state: Any) -> None:  # noqa: B027 -- flat ones have none
        """Restore the random parts; the world restores the poses of bodies."""

    # -- placements --------------------------------------------------------------------------

    def scatter(
        self,
        rng: np.random.Generator,
        bodies: Sequence[Body],
        spacings: Sequence[Spacing],
        draw_yaw: Callable[[Body], float],
        *,
        base: Body,
    ) -> None:
        """Place bodies at random poses on the ground, apart from each other.

        Args:
            draw_yaw: returns a random yaw of a body.
            base: one of the bodies, on which a structure can stand. It starts in the build area if
                structures can only stand in a part of the ground.
        """
        points = random_points(self.spawn_area, rng, spacings)
        for body, xy in zip(bodies, points, strict=True):
            self.stand(body, xy, draw_yaw(body))

    def stand(self, body: Body, xy: tuple[float, float], yaw_rad: float) -> None:
        """Place a body on the surface, its z axis along the normal."""
        offset = Pose((0.0, 0.0, -body.shape.bounds_m[0][2]))
        body.set_pose(*self.surface_pose(xy, yaw_rad).compose(offset))

    # -- heights -----------------------------------------------------------------------------

    def gap_below_m(self, body: Body) -> float:
        """Return the height of the lowest point of a body above the surface below its origin."""
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
            rotation: rotation of the tool; None if it points down.
            opening: opening of the gripper before it closes, 0 to 1.
        """
        return self.height_m(xy) + gripper.lowest_tool_m(rotation, opening)


class Flat(Terrain):
    """The floor of the world, horizontal at height zero."""

    @property
    def support_ids(self) -> frozenset[int]:
        """PyBullet id of the floor."""
        return frozenset((self.world.floor,))

    def height_m(self, xy: tuple[float, float]) -> float:
        """Return zero."""
        return 0.0
