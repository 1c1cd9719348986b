"""Box Palletizing: stack boxes on a pallet, in layers of alternating direction (appendix A.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ba_torchrl.core.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.core.errors import PlacementError
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.control.pick_place import PickPlaceLimits
from ba_torchrl.sim.geometry import Pose, Vector, carrying_pose
from ba_torchrl.sim.shapes import Box
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.instructions import colored, counted
from ba_torchrl.tasks.manipulation.footprints import Rectangle, gap_m, gaps_m, narrowest, outline
from ba_torchrl.tasks.manipulation.pick_place_commands import (
    LEVEL_RAD,
    no_op,
    perturbed_pick,
    pick_command,
    place_command,
    swaps_fingers,
)
from ba_torchrl.tasks.manipulation.top_down_grasps import is_reachable
from ba_torchrl.tasks.packing.base import (
    FILLING_ORDERS,
    RELEASE_GAP_M,
    SUFFICIENT_CLEARANCE_M,
    PackingTask,
)
from ba_torchrl.tasks.packing.layout import Footprint, random_rectangle, scatter
from ba_torchrl.tasks.packing.tilted_grasps import tilted_grasp
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD
from ba_torchrl.tasks.structures.pieces import CUBOID
from ba_torchrl.tasks.structures.tilts import release_pose

PALLET_M = (0.232, 0.192, 0.03)
"""Extents of the pallet; all lengths are at the appendix's size."""
BOX_M = (0.045, 0.072, 0.045)
"""Extents of a box, longest along y."""
PER_LAYER = 6
"""Boxes in a layer."""
ROW_M = 0.067
"""Distance between the centres of boxes side by side, with space for fingers between them."""
COLUMN_M = 0.088
"""Distance between the centres of boxes end to end."""
PATTERN_M = 2 * ROW_M + BOX_M[0]
"""Larger extent of a layer."""
SLOT_M = 0.01
"""Largest offset of a box in a slot, along either side of the pallet."""
SLOT_RAD = math.pi / 8
"""Largest yaw error of a box in a slot."""
GRASP_DEPTH_M = 0.008
"""Depth of a grasp below the top of a box, where the fingers fit between its neighbours."""
TIP_OVER_M = 0.008
"""Distance beyond the pallet's edge at which an upended box is released, so that it tips over."""
TIP_SITES = 2
"""Sites on each side of the centre of the edge that are compared for this."""
BLOCKED_M = -5e-3
"""Clearance of a grasp below which it is likely to fail."""
MAX_SHIFT = 0.6
"""Largest offset at which a box is placed in a slot, as a multiple of `SLOT_M`."""
SHIFT_STEP = 0.05
"""Step of the offsets that are compared, as a multiple of `SLOT_M`."""
RELEASE_MARGIN_M = 1e-3
"""Margin between a finger that opens at a release and the box beside it."""
FREE_HALF_M = (0.056, 0.016)
"""Half the extents of the free area around a box at the start."""
SETTLE_STEPS = 100
"""Largest number of physics steps until a new box is at rest."""
LAYOUTS = 20
"""Random positions of the pallet before a `PlacementError`."""


def slots(layer: int) -> list[tuple[float, float, float]]:
    """Return x, y and yaw of the slots of a layer in the pallet's frame, at the appendix's size.

    A layer is two columns of three boxes. Odd layers are rotated by 90 degrees.

    Args:
        layer: number of the layer, from 0 at the bottom.
    """
    places = [(side * COLUMN_M / 2, row * ROW_M) for side in (1, -1) for row in (-1, 0, 1)]
    if layer % 2 == 0:
        return [(x, y, math.pi / 2) for x, y in places]
    return [(-y, x, 0.0) for x, y in places]


@TASKS.register("open_loop/box_palletizing")
class BoxPalletizing(PackingTask):
    """Objects: 6, 12 or 18 boxes of 7.2 x 4.5 x 4.5 cm, 18 by default, and a pallet.

    Goal: each slot of each layer on the pallet of 23.2 x 19.2 x 3 cm has its box, and none is held.
    A box is stacked if it lies in a slot and all layers below it are full. The next box arrives
    when all earlier ones are stacked and none is held. The episode ends early when a box leaves the
    workspace. Paper, appendix A.1.
    """

    expert_version = 1
    scale_limits = (0.75, 1.0)
    max_steps = 40
    num_objects = 18
    num_objects_range = (6, 18)
    num_objects_step = PER_LAYER
    container_m = PALLET_M

    def load_scene(self) -> None:
        """Load the pallet and all boxes."""
        pallet, box = (tuple(s * self.unit for s in size) for size in (PALLET_M, BOX_M))
        color = (0.55, 0.42, 0.28, 1.0)
        self.container = self.world.add(Box(size_m=pallet, mass_kg=0.0, color=color), "pallet")
        shape = Box(size_m=box, color=(0.85, 0.66, 0.4, 1.0))
        count = self.settings.num_objects
        self.pool = BodyPool(self.world, [shape] * count, [f"box {i + 1}" for i in range(count)])
        self._arrivals: list[tuple[tuple[float, float], float]] = []
        """Position and yaw at which each box arrives."""

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the pallet at a random pose, and the first box beside it."""
        half_x, half_y, _ = (size * self.unit / 2 for size in PALLET_M)
        width, length, _ = (size * self.unit / 2 for size in BOX_M)
        hand = tuple(size * self.unit for size in FREE_HALF_M)
        footprint = Footprint(width, length, *hand)
        for attempt in range(LAYOUTS):
            pallet = random_rectangle(self, rng, half_x, half_y, fixed_yaw_rad=math.pi / 2)
            try:
                stack = pallet.resized(PATTERN_M * self.unit / 2, PATTERN_M * self.unit / 2)
                self._arrivals = [
                    scatter(self, rng, [footprint], [pallet], clear_of=stack)[0]
                    for _ in range(self.settings.num_objects)
                ]
                break
            except PlacementError:
                if attempt == LAYOUTS - 1:
                    raise
        self.stand(self.container, (pallet.x, pallet.y), pallet.yaw_rad)
        self.pool.clear()
        self._activate_next_box()

    def after_action(self) -> None:
        """Let the next box arrive when all earlier ones are stacked and none is held."""
        count = len(self.pool.active)
        if count == self.settings.num_objects or self.robot.held_body() is not None:
            return
        if len(self.stacked()) == count:
            self._activate_next_box()
            self.world.settle(SETTLE_STEPS)

    def evaluate(self) -> dict[str, bool]:
        """Return whether every slot has its box."""
        return {"is_stacked": len(self.stacked()) == self.settings.num_objects}

    def stacked(self) -> dict[tuple[int, int], Body]:
        """Return the stacked, released boxes by layer and number of their slots."""
        held, pallet = self.robot.held_body(), self.container_outline()
        found: dict[tuple[int, int], Body] = {}
        for body in self.pool.active:
            slot = None if body is held else self._slot_of(body, pallet)
            if slot is not None:
                found[slot] = body
        full = 0
        while all((full, number) in found for number in range(PER_LAYER)):
            full += 1
        return {slot: body for slot, body in found.items() if slot[0] <= full}

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool for a pick without z, just below the highest point."""
        return max(top_m - GRASP_DEPTH_M * self.unit, self.lowest_tool_m(xy))

    def get_state(self) -> Any:
        """Return the indices of the active boxes, and where each box arrives."""
        return super().get_state(), list(self._arrivals)

    def set_state(self, state: Any) -> None:
        """Restore the active boxes, and where each box arrives."""
        active, self._arrivals = state
        super().set_state(active)

    def instruction(self) -> str:
        """Return the instruction with number and colour of the boxes."""
        return (
            f"stack the {counted(self.settings.num_objects, colored(self.pool.bodies[0], 'box'))} "
            f"on the {colored(self.container, 'pallet')}{self.terrain.place_words}"
        )

    def expert_command(self) -> PickPlaceCommand:
        """Place the highest box that is not stacked in the next slot."""
        held = self.robot.held_body()
        stacked = self.stacked()
        if held is not None:
            return self._place_in_slot(held, stacked)
        unstacked = [body for body in self.pool.active if body not in stacked.values()]
        if not unstacked:
            return no_op(self.settings.workspace, is_holding=False)
        grasps = {body: self.grasp(body) for body in unstacked}

        def priority(body: Body) -> tuple[float, bool, float]:
            level = round(vertical_extent(body)[1] / (BOX_M[2] * self.unit / 2))
            return level, grasps[body].clearance_m > 0, grasps[body].clearance_m

        body = max(unstacked, key=priority)
        tool, clearance_m = grasps[body].tool, grasps[body].clearance_m
        if self.action_limits.can_tilt and CUBOID.tilt_rad(body) > LEVEL_RAD:
            tilted = tilted_grasp(
                self.robot,
                self.terrain.support_ids,
                body,
                [other for other in (*self.pool.active, self.container) if other is not body],
                above_centre_m=(BOX_M[2] / 2 - GRASP_DEPTH_M) * self.unit,
                offsets_m=[offset * self.unit for offset in self.grasp_offsets_m],
                opening=self.finger_opening,
            )
            if tilted is not None:
                tool, clearance_m = tilted
        if clearance_m < BLOCKED_M:
            return perturbed_pick(self.world, body, tool, self.action_limits)
        return pick_command(tool)

    # ----------------------------------------------------------------------------------------

    def _activate_next_box(self) -> None:
        """Place the next box where it arrives."""
        number = len(self.pool.active)
        box = self.pool.bodies[number]
        self.pool.activate(box)
        self.stand(box, *self._arrivals[number])

    def _level_z_m(self, layer: int) -> float:
        """Return the height of the centres of a layer's boxes."""
        base = self.container.position[2] + PALLET_M[2] * self.unit / 2
        return base + (layer + 0.5) * BOX_M[2] * self.unit

    def _slot_of(self, body: Body, pallet: Rectangle) -> tuple[int, int] | None:
        """Return layer and number of the slot in which a box lies; None if it lies in none."""
        x, y, z = body.position
        height = BOX_M[2] * self.unit
        layer = round((z - self._level_z_m(0)) / height)
        is_level = (
            0 <= layer < self.settings.num_objects // PER_LAYER
            and abs(z - self._level_z_m(layer)) <= height / 4
            and CUBOID.tilt_rad(body) <= UPRIGHT_RAD
        )
        if not is_level:
            return None
        along, across = pallet.frame.to_local(x, y)
        heading = CUBOID.yaw_rad(body) - pallet.yaw_rad
        for number, (slot_x, slot_y, yaw) in enumerate(slots(layer)):
            offset = max(abs(along - slot_x * self.unit), abs(across - slot_y * self.unit))
            if offset <= SLOT_M * self.unit:
                is_along = abs(wrap_angle(heading - yaw, math.pi)) <= SLOT_RAD
                return (layer, number) if is_along else None
        return None

    def _place_in_slot(self, held: Body, stacked: dict[tuple[int, int], Body]) -> PickPlaceCommand:
        """Return the place in the next free slot, or on the ground if an obstacle is in each."""
        if CUBOID.tilt_rad(held) > math.pi / 4:
            return self._tip_over(held)
        layer = min(len(stacked) // PER_LAYER, self.settings.num_objects // PER_LAYER - 1)
        pallet, heading = self.container_outline(), CUBOID.yaw_rad(held)
        width, length, height = (size * self.unit / 2 for size in BOX_M)
        z = self._level_z_m(layer) + RELEASE_GAP_M
        obstacles = [
            outline(body)
            for body in self.pool.active
            if body is not held and body not in stacked.values()
        ]
        neighbors = [outline(body) for slot, body in stacked.items() if slot[0] == layer]
        places = slots(layer)
        for number in self._order(layer, stacked):
            if (layer, number) in stacked:
                continue
            x, y, yaw = places[number]
            center = Rectangle(
                *pallet.frame.to_world(x * self.unit, y * self.unit),
                pallet.yaw_rad + yaw,
                width,
                length,
            )
            row = round((x * math.cos(yaw) + y * math.sin(yaw)) / ROW_M)
            site = self._site(center, row, neighbors)
            if all(gap_m(site, other) > 0 for other in obstacles):
                return self._level_place(held, (site.x, site.y, z), site.yaw_rad) or self.place(
                    held, (site.x, site.y, z), site.yaw_rad - heading
                )
        (x, y), yaw = max(self._arrivals, key=lambda arrival: self._gap_at_m(arrival, held))
        z = self.terrain.height_m((x, y)) + height + RELEASE_GAP_M
        return self.place(held, (x, y, z), yaw - heading)

    def _order(self, layer: int, stacked: dict[tuple[int, int], Body]) -> Sequence[int]:
        """Return the slots of a layer in the order in which they are filled.

        Columns are filled from the corner farthest from the workspace's centre, so that the next
        slot does not depend on which of the two ends of the symmetric pallet is its front.
        """
        frame, center = self.container_outline().frame, self.settings.workspace.center

        def preference(order: Sequence[int]) -> tuple[list[bool], float]:
            filled = [(layer, number) in stacked for number in order]
            x, y, _ = slots(layer)[order[filled.index(False) if False in filled else 0]]
            corner = frame.to_world(x * self.unit, y * self.unit)
            return filled, math.dist(corner, center)

        return max(FILLING_ORDERS, key=preference)

    def _site(self, slot: Rectangle, row: int, neighbors: Sequence[Rectangle]) -> Rectangle:
        """Return the site in a slot, as little off its centre as the fingers need.

        The fingers need space to descend. As they open, they push a box that is closer than it
        should be back to its slot. Grippers with thicker fingers than the gap between slots place
        the outer boxes of a column apart by what it lacks.

        Args:
            row: -1, 0 or 1: the position of the slot along its x axis.
            neighbors: outlines of the other boxes in the layer.
        """
        half_m, step_m = self._finger_depth_m / 2, SHIFT_STEP * SLOT_M * self.unit
        count = round(MAX_SHIFT / SHIFT_STEP)
        lacking_m = self._finger_depth_m + self._release_m - (ROW_M - BOX_M[0]) * self.unit
        base = row * min(max(math.ceil(lacking_m / step_m), 0), count)
        shifts_m = [
            step_m * n for n in sorted(range(-count, count + 1), key=lambda n: abs(n - base))
        ]
        fingers = [
            Rectangle(
                *slot.frame.to_world(shift_m + side * (slot.half_x + half_m), 0.0),
                slot.yaw_rad,
                half_m,
                self.robot.gripper.half_width_m,
            )
            for shift_m in shifts_m
            for side in (-1, 1)
        ]
        gaps = gaps_m(fingers, neighbors).min(axis=1, initial=math.inf)
        spaces = np.minimum(gaps.reshape(-1, 2).min(axis=1), 0.0)
        shift_m = shifts_m[int(spaces.argmax())]
        return Rectangle(*slot.frame.to_world(shift_m, 0.0), *slot[2:])

    def _level_place(self, held: Body, position: Vector, yaw_rad: float) -> PickPlaceCommand | None:
        """Return the place at which a box that is tilted in the gripper is level, if there is one.

        Args:
            position: final position of its centre.
            yaw_rad: its final yaw, up to half turns.
        """
        if not self.action_limits.can_tilt or CUBOID.tilt_rad(held) < LEVEL_RAD:
            return None
        tool, heading = self.robot.tool_frame(), CUBOID.yaw_rad(held)
        turn = wrap_angle(yaw_rad - heading, math.pi)
        for yaw in (heading + turn, heading + turn + math.pi):
            target = release_pose(CUBOID, held, Pose(position), yaw)
            pose = carrying_pose(tool, held.pose, target)
            if not swaps_fingers(pose) and is_reachable(
                self.robot, self.terrain.support_ids, pose, PickPlaceLimits().pre_place_height_m
            ):
                return place_command(tool, held.pose, target)
        return None

    @property
    def _finger_depth_m(self) -> float:
        """Space that a finger needs beside a held box, along the closing axis."""
        gripper = self.robot.gripper
        depth_m = gripper.finger_reach_below_m(GRASP_DEPTH_M * self.unit, 0.0)
        return depth_m + RELEASE_MARGIN_M

    @property
    def _release_m(self) -> float:
        """Distance by which a finger opens at a release."""
        return PickPlaceLimits().release_opening * self.robot.gripper.half_gap_m

    def _tip_over(self, held: Body) -> PickPlaceCommand:
        """Return the place at the pallet's edge from which an upended box tips over."""
        pallet, own = self.container_outline(), narrowest(held, self.robot.tool_pose()[1])[0]
        width, length, _ = (size * self.unit / 2 for size in BOX_M)
        others = [outline(body) for body in self.pool.active if body is not held]
        workspace = self.settings.workspace
        best: tuple[float, tuple[float, float]] | None = None
        for side in (-1, 1):
            for number in range(-TIP_SITES, TIP_SITES + 1):
                across = number / (TIP_SITES + 1) * (pallet.half_y - width)
                edge = side * pallet.half_x
                landing = Rectangle(
                    *pallet.frame.to_world(edge + side * (length + 2 * TIP_OVER_M), across),
                    pallet.yaw_rad,
                    length + 2 * TIP_OVER_M,
                    width,
                )
                gap = min((gap_m(landing, other) for other in others), default=math.inf)
                inside = 1.0 if landing.is_inside(workspace) else 0.0
                score = inside + min(gap, SUFFICIENT_CLEARANCE_M)
                if best is None or score > best[0]:
                    site = pallet.frame.to_world(edge + side * TIP_OVER_M, across)
                    best = (score, site)
        z = self._level_z_m(0) - BOX_M[2] * self.unit / 2 + RELEASE_GAP_M
        z += held.position[2] - vertical_extent(held)[0]
        # the fingers close along the edge and do not obstruct the fall
        return self.place(held, (*best[1], z), pallet.yaw_rad + math.pi / 2 - own.yaw_rad)

    def _gap_at_m(self, arrival: tuple[tuple[float, float], float], held: Body) -> float:
        """Return the gap between a box at a position and yaw on the ground and all others."""
        width, length, _ = (size * self.unit / 2 for size in BOX_M)
        site = Rectangle(*arrival[0], arrival[1], width, length)
        others = [outline(body) for body in self.pool.active if body is not held]
        return min((gap_m(site, other) for other in others), default=math.inf)
