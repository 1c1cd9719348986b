"""Bottle Arrangement: place six bottles upright in a tray (appendix A.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ba_torchrl.core.actions import PickPlaceCommand
from ba_torchrl.core.errors import PlacementError
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.sim.meshes import lathe_parts
from ba_torchrl.sim.shapes import Color, Solid
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.instructions import colored, counted
from ba_torchrl.tasks.manipulation.clearance import half_gap_m
from ba_torchrl.tasks.manipulation.footprints import Rectangle
from ba_torchrl.tasks.manipulation.hand_clearance import outline_clearances_m
from ba_torchrl.tasks.manipulation.pick_place_commands import no_op, pick_command
from ba_torchrl.tasks.manipulation.top_down_grasps import TopDownGrasp
from ba_torchrl.tasks.packing.base import FILLING_ORDERS, RELEASE_GAP_M, PackingTask, open_box
from ba_torchrl.tasks.packing.layout import Footprint, random_rectangle, scatter
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD

TRAY_M = (0.24, 0.16, 0.05)
"""Outer extents of the tray, at the appendix's size."""
WALL_M = 0.01
"""Thickness of the tray's walls, at the appendix's size."""
FLOOR_M = 0.005
"""Thickness of the tray's floor, at the appendix's size."""

BOTTLES_CM: dict[str, tuple[tuple[float, float], ...]] = {
    "wine bottle": ((2.4, 0), (2.4, 7.5), (1.3, 10), (1.3, 14)),
    "soda bottle": ((2.1, 0), (2.5, 1.5), (2.5, 6.5), (1.4, 10), (1.4, 13.8)),
    "jar": ((2.4, 0), (2.4, 9), (1.9, 10), (1.9, 13.4)),
    "flask": ((2.5, 0), (1.3, 9.5), (1.3, 13.6)),
    "shaker": ((2.5, 0), (2.5, 3), (1.8, 6), (2.2, 8.5), (1.5, 10), (1.5, 14)),
    "can": ((2.3, 0), (2.3, 13)),
    "carafe": ((1.9, 0), (2.5, 2.5), (2.5, 5), (1.2, 9.6), (1.2, 13.6)),
    "flagon": ((2.45, 0), (2.45, 9.3), (1.15, 10.4), (1.15, 14.4)),
}
"""Radius and height of the corners of each bottle's profile, centimetres at the appendix's size.
The fingers close on the straight uppermost part."""
COLORS: tuple[Color, ...] = (
    (0.25, 0.45, 0.3, 1.0),
    (0.8, 0.25, 0.2, 1.0),
    (0.85, 0.7, 0.3, 1.0),
    (0.3, 0.5, 0.8, 1.0),
    (0.6, 0.6, 0.65, 1.0),
    (0.75, 0.4, 0.65, 1.0),
    (0.35, 0.7, 0.7, 1.0),
    (0.5, 0.35, 0.25, 1.0),
)
MASS_KG = 0.15
CENTER_OF_MASS_M = 0.02
"""Height of a bottle's centre of mass. From a tilt of up to 45 degrees it returns to upright."""
BOTTLE_M = 0.05
"""Largest diameter of a bottle, at the appendix's size."""
DISTANCE_M = 0.096
"""Least distance between the axes of bottles, and of bottles and slots, at the start."""
FLOOR_TOLERANCE_M = 0.003
"""Largest height above the tray's floor of a bottle that stands on it."""
GRASP_YAWS = 8
"""Yaws per half turn that are compared."""
NEIGHBOR_GAP_M = 0.003
"""Gap wanted between bottles in the tray."""
SEARCH_STEP_M = 0.01
"""Grid spacing of the sites outside the slots."""
LAYOUTS = 20
"""Random positions of the tray before a `PlacementError`."""


def slots() -> list[tuple[float, float]]:
    """Return the positions of the slots in the tray's frame, at the appendix's size.

    The centres of equal cells: the gap between two bottles is twice that to a wall.
    """
    length, width = (outer - 2 * WALL_M for outer in TRAY_M[:2])
    return [(x, y) for y in (-width / 4, width / 4) for x in (-length / 3, 0.0, length / 3)]


@TASKS.register("open_loop/bottle_arrangement")
class BottleArrangement(PackingTask):
    """Objects: six bottles of eight kinds, 5 cm wide and 13 to 14.4 cm high, and a tray.

    Goal: all bottles stand in the tray of 24 x 16 x 5 cm, and none is held. The episode ends early
    when a bottle tips over or leaves the workspace. Paper, appendix A.1.
    """

    scale_limits = (0.4, 0.8)
    max_steps = 20
    num_objects = 6
    num_objects_range = (6, 6)
    finger_opening = 0.8
    container_m = TRAY_M

    def load_scene(self) -> None:
        """Load the tray, and as many bottles of each kind as an episode may draw."""
        tray = open_box(
            tuple(size * self.unit for size in TRAY_M),
            WALL_M * self.unit,
            FLOOR_M * self.unit,
            (0.72, 0.56, 0.38, 1.0),
        )
        self.container = self.world.add(tray, "tray")
        self._kinds = [
            Solid(
                parts=tuple(
                    lathe_parts([(r * self.unit / 100, z * self.unit / 100) for r, z in profile])
                ),
                mass_kg=MASS_KG,
                color=color,
                center_of_mass_m=(0.0, 0.0, CENTER_OF_MASS_M * self.unit),
            )
            for profile, color in zip(BOTTLES_CM.values(), COLORS, strict=True)
        ]
        copies = self.settings.num_objects
        self.pool = BodyPool(
            self.world,
            [shape for shape in self._kinds for _ in range(copies)],
            [f"{name} {i + 1}" for name in BOTTLES_CM for i in range(copies)],
        )

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the tray at a random pose, and random bottles around it."""
        count = self.settings.num_objects
        length, width, _ = (size * self.unit for size in TRAY_M)
        half = BOTTLE_M * self.unit / 2
        footprint = Footprint(half, half, margin_m=(DISTANCE_M - BOTTLE_M) * self.unit)
        for attempt in range(LAYOUTS):
            tray = random_rectangle(self, rng, length / 2, width / 2)
            # bottles start as far from the slots as from each other
            reserved = tray.resized(length / 3 + half, width / 4 + half)
            try:
                places = scatter(self, rng, [footprint] * count, [reserved])
                break
            except PlacementError:
                if attempt == LAYOUTS - 1:
                    raise
        self.stand(self.container, (tray.x, tray.y), tray.yaw_rad)
        self.pool.clear()
        for i, (xy, yaw) in enumerate(places):
            kind = int(rng.integers(len(self._kinds)))
            bottle = self.pool.bodies[kind * count + i]
            self.pool.activate(bottle)
            self.stand(bottle, xy, yaw)

    def evaluate(self) -> dict[str, bool]:
        """Return whether all bottles stand in the tray and whether none is held."""
        return {
            "is_released": self.robot.held_body() not in self.objects,
            "is_arranged": all(map(self.stands_in_tray, self.objects)),
        }

    def is_valid(self) -> bool:
        """Whether all bottles are inside the workspace, and upright or held."""
        held = self.robot.held_body()
        return super().is_valid() and all(
            body is held or body.tilt_rad < UPRIGHT_RAD for body in self.objects
        )

    def stands_in_tray(self, body: Body) -> bool:
        """Whether a bottle stands on the floor of the tray."""
        floor = self._floor_z_m()
        return (
            body.tilt_rad < UPRIGHT_RAD
            and abs(body.position[2] - floor) <= FLOOR_TOLERANCE_M
            and self._inside().contains(np.array([body.position]))
        )

    def instruction(self) -> str:
        """Return the instruction with the number of bottles and the tray's colour."""
        return (
            f"stand the {counted(len(self.objects), 'bottle')} in the "
            f"{colored(self.container, 'tray')}"
        )

    def expert_command(self) -> PickPlaceCommand:
        """Place a bottle that is not in the tray in the next free slot."""
        held = self.robot.held_body()
        if held is not None:
            x, y = self._free_site(held)
            floor = self._floor_z_m()
            yaw = self.robot.tool_pose()[1]
            if self.action_limits.turn_rad:
                obstacles = self.obstacles(held, floor + self.depth_m(held) + self.tips_m)
                yaw, _ = self._best_yaw((x, y), self.release_half_m(held), obstacles)
            turn = yaw - self.robot.tool_pose()[1]
            return self.place(held, (x, y, floor + RELEASE_GAP_M), turn)
        outside = [body for body in self.objects if not self.stands_in_tray(body)]
        if not outside:
            return no_op(self.settings.workspace, is_holding=False)
        grasps = {body: self.grasp(body) for body in outside}
        if self._neighbor_gap_m(self._free_site(None), None) < NEIGHBOR_GAP_M:
            # bottles outside the slots leave no free site: one of them is moved to a slot
            grasps = {body: self.grasp(body) for body in self.objects if body not in grasps}
            body = max(
                grasps, key=lambda body: (grasps[body].clearance_m > 0, self._slot_offset_m(body))
            )
            return pick_command(grasps[body].tool)
        body = max(outside, key=lambda body: round(grasps[body].clearance_m, 4))
        return pick_command(grasps[body].tool)

    def grasp(self, body: Body) -> TopDownGrasp:
        """Return the grasp of a bottle by its neck, at the yaw with the largest clearance."""
        height = self.pick_height_m(vertical_extent(body)[1], body.position[:2])
        obstacles = self.obstacles(body, height + self.tips_m)
        x, y, _ = body.position
        half = half_gap_m(self.robot.gripper, self.finger_opening)
        yaw, clearance_m = self._best_yaw((x, y), half, obstacles)
        return TopDownGrasp(body, (x, y, height), yaw, clearance_m)

    # ----------------------------------------------------------------------------------------

    def _best_yaw(
        self, xy: tuple[float, float], half_opening_m: float, obstacles: Sequence[Rectangle]
    ) -> tuple[float, float]:
        """Return the yaw at which fingers at a position have the largest clearance, and this."""
        yaws = [0.0]
        if self.action_limits.turn_rad:
            first = self.container.yaw_rad + math.pi / 4  # a diagonal of the tray
            yaws = [first + math.pi * i / GRASP_YAWS for i in range(GRASP_YAWS)]
        tools = [PlanarFrame(*xy, yaw) for yaw in yaws]
        gripper = self.robot.gripper
        clearances_m = outline_clearances_m(gripper, tools, half_opening_m, obstacles).tolist()
        rounded = [round(clearance_m, 4) for clearance_m in clearances_m]
        best = rounded.index(max(rounded))
        return yaws[best], clearances_m[best]

    def _floor_z_m(self) -> float:
        """Return the height of the floor of the tray."""
        return self.container.position[2] + (FLOOR_M - TRAY_M[2] / 2) * self.unit

    def _inside(self) -> Rectangle:
        """Return the inner outline of the tray."""
        tray, wall = self.container_outline(), WALL_M * self.unit
        return tray.resized(tray.half_x - wall, tray.half_y - wall)

    def _slot_offset_m(self, body: Body) -> float:
        """Return the distance between a bottle and the nearest slot."""
        tray = self.container_outline()
        return min(
            math.dist(body.position[:2], tray.frame.to_world(x * self.unit, y * self.unit))
            for x, y in slots()
        )

    def _neighbor_gap_m(self, site: tuple[float, float], held: Body | None) -> float:
        """Return the gap between a bottle at a site and all others but the held one."""
        return min(
            (
                math.dist(site, body.position[:2]) - BOTTLE_M * self.unit
                for body in self.objects
                if body is not held
            ),
            default=math.inf,
        )

    def _free_site(self, held: Body | None) -> tuple[float, float]:
        """Return the next free slot, or the site in the tray with the largest gap.

        Rows are filled from the corner farthest from the bottles outside, so that the next slot
        does not depend on which of the two ends of the symmetric tray is its front.
        """
        tray = self.container_outline()
        sites = [tray.frame.to_world(x * self.unit, y * self.unit) for x, y in slots()]
        are_filled = [self._neighbor_gap_m(site, held) < NEIGHBOR_GAP_M for site in sites]
        if not all(are_filled):
            outside = [
                body.position[:2]
                for body in self.objects
                if body is not held and not self.stands_in_tray(body)
            ]

            def preference(order: Sequence[int]) -> tuple[list[bool], float]:
                filled = [are_filled[slot] for slot in order]
                first = sites[order[filled.index(False)]]
                away = min((math.dist(first, point) for point in outside), default=0.0)
                return filled, away

            order = max(FILLING_ORDERS, key=preference)
            return next(sites[slot] for slot in order if not are_filled[slot])
        inside, half = self._inside(), BOTTLE_M * self.unit / 2 + NEIGHBOR_GAP_M
        along, across = inside.half_x - half, inside.half_y - half
        sites += [
            tray.frame.to_world(x, y)
            for x in np.arange(-along, along + 1e-9, SEARCH_STEP_M).tolist()
            for y in np.arange(-across, across + 1e-9, SEARCH_STEP_M).tolist()
        ]
        return max(sites, key=lambda site: self._neighbor_gap_m(site, held))
