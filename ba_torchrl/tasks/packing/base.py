"""What the open-loop tasks share that bring objects from the floor to a container."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import pybullet

from ba_torchrl.actions import PickPlaceCommand
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import PlanarFrame, Vector, YawPose
from ba_torchrl.sim.meshes import box_mesh, frame_parts, merge_meshes, transform_mesh
from ba_torchrl.sim.shapes import Color, Solid
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.clearance import half_gap_m, hand_rectangle, outline_clearance_m
from ba_torchrl.tasks.footprints import Rectangle, gap_m, narrowest, outline
from ba_torchrl.tasks.grasps import TopDownGrasp
from ba_torchrl.tasks.open_loop_task import OpenLoopControl
from ba_torchrl.tasks.pick_place_commands import place_command

SCALE = 0.8
"""At this scale, objects have the sizes of appendix A.1."""
RELEASE_M = 0.004
"""How far a finger opens to let go."""
RELEASE_GAP_M = 1e-3
"""What is held is let go this far above what it will rest on."""
ENOUGH_M = 4e-3
"""More room beside the fingers than this is worth nothing."""
TURN_MARGIN_RAD = 1e-4
UNDERGROUND_M = 0.02
"""A container's floor goes on below the ground: what falls fast passes through a thin sheet."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Blocks(Solid):
    """A body whose parts are boxes along its axes: collisions with boxes cost less than hulls."""

    collision_margin_m: ClassVar[float | None] = None

    def create_collision(self, client: int) -> int:
        """Create one box for each part."""
        corners = [(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part in self.parts]
        return pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(corners),
            halfExtents=[((high - low) / 2).tolist() for low, high in corners],
            collisionFramePositions=[((high + low) / 2).tolist() for low, high in corners],
            physicsClientId=client,
        )


def open_box(size_m: Vector, wall_m: float, floor_m: float, color: Color) -> Blocks:
    """Return a static box without a lid, its bounding box centred on the origin.

    Args:
        size_m: outer extents.
        wall_m: thickness of the walls.
        floor_m: thickness of the floor, as far as it is above ground.
        color: red, green, blue, alpha.
    """
    x, y, z = size_m
    walls = frame_parts(size_m, wall_m)
    inside = (x - 2 * wall_m, y - 2 * wall_m)
    sheet = transform_mesh(box_mesh((*inside, floor_m)), (0.0, 0.0, (floor_m - z) / 2))
    depth = floor_m + UNDERGROUND_M
    slab = transform_mesh(box_mesh((*inside, depth)), (0.0, 0.0, floor_m - (z + depth) / 2))
    return Blocks(
        parts=(*walls, slab), surface=merge_meshes([*walls, sheet]), mass_kg=0.0, color=color
    )


class PackingTask(OpenLoopControl, Task):
    """Objects from a pool on the floor, and a container that does not move."""

    scale_range = (SCALE, SCALE)
    finger_opening = 0.7

    grasp_offsets_m: ClassVar[tuple[float, ...]] = (0.0, 0.008, -0.008, 0.022, -0.022)
    """How far from its middle a long object may be held, at scale `SCALE`."""

    container: Body
    pool: BodyPool

    @property
    def unit(self) -> float:
        """Sizes of this episode as a multiple of the appendix's."""
        return self.settings.scale / SCALE

    @property
    def objects(self) -> Sequence[Body]:
        """The objects in the scene."""
        return self.pool.present

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """Objects and container; for objects yet to come, the workspace's upper corner."""
        workspace = self.settings.workspace
        corner = (workspace.x[1], workspace.y[1], workspace.z[1])
        bodies = [*self.pool.present, self.container]
        missing = self.settings.num_objects - len(self.pool.present)
        return [(body.position, body.yaw_rad) for body in bodies] + [(corner, 0.0)] * missing

    def get_state(self) -> Any:
        """Return which objects are in the scene."""
        return self.pool.get_state()

    def set_state(self, state: Any) -> None:
        """Take up what `get_state` returned."""
        self.pool.set_state(state)

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height at which what is held comes to rest on what is highest there."""
        held = self.robot.held_body()
        if held is None:
            return super().place_height_m(top_m, xy)
        return top_m + self.depth_m(held) + RELEASE_GAP_M

    def depth_m(self, held: Body) -> float:
        """Return how far what is held reaches down below the tool point."""
        return self.robot.tool_pose()[0][2] - vertical_extent(held)[0]

    # -- parts of the experts ----------------------------------------------------------------

    def obstacles(self, body: Body | None, above_m: float) -> list[Rectangle]:
        """Return the outlines of what fingers may meet at a height.

        Args:
            body: that they are about to grasp.
            above_m: lower things are not in their way.
        """
        held = self.robot.held_body()
        return [
            outline(other)
            for other in (*self.pool.present, self.container)
            if other is not body and other is not held and vertical_extent(other)[1] > above_m
        ]

    def grasp(self, body: Body) -> TopDownGrasp:
        """Return where to grasp an object: in its middle, or where the fingers have more room."""
        height = self.pick_height_m(vertical_extent(body)[1], body.position[:2])
        gripper = self.robot.gripper
        others = self.obstacles(body, height + self.tips_m)
        tall = self.obstacles(body, height + gripper.palm_height_m)
        half_open = half_gap_m(gripper, self.finger_opening)
        choices = []
        for side in narrowest(body, None if self.action_limits.turn_rad else 0.0):
            for offset in self.grasp_offsets_m:
                if abs(offset * self.unit) > max(side.half_y - 0.012, 0.0):
                    continue
                xy = side.frame.to_world(0.0, offset * self.unit)
                tool = PlanarFrame(*xy, side.yaw_rad)
                room = outline_clearance_m(gripper, tool, half_open, others)
                hand = hand_rectangle(self.robot, tool)
                room = min([room, *(gap_m(hand, other) for other in tall)])
                choices.append(TopDownGrasp(body, (*xy, height), side.yaw_rad, room))
        return max(choices, key=lambda choice: min(choice.clearance_m, ENOUGH_M))

    def place(self, held: Body, position: Vector, turn_rad: float) -> PickPlaceCommand:
        """Return the place that brings what is held somewhere, up to half turns.

        Args:
            held: what is held.
            position: of its origin.
            turn_rad: about the vertical, from how it is held now.
        """
        tool = self.robot.tool_frame()
        yaw = (tool.yaw_rad + turn_rad) % math.pi if self.action_limits.turn_rad else 0.0
        if yaw > math.pi - TURN_MARGIN_RAD:
            yaw = 0.0
        return place_command(tool, held.pose, held.pose.moved_to(position, yaw - tool.yaw_rad))

    @property
    def tips_m(self) -> float:
        """Height above the tool point at which the open fingers end."""
        gripper = self.robot.gripper
        return gripper.tip_height_m(self.finger_opening * gripper.half_gap_m)

    def release_half_m(self, held: Body) -> float:
        """Return how far from the tool point the fingers' inner sides are as they let go."""
        tool, yaw = self.robot.tool_pose()
        around = outline(held, yaw)
        return abs(around.frame.to_local(*tool[:2])[0]) + around.half_x + RELEASE_M
