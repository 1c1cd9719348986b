"""Bottle Arrangement: stand six bottles in a tray (appendix A.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ba_torchrl.actions import PickPlaceCommand
from ba_torchrl.errors import PlacementError
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.sim.meshes import lathe_parts
from ba_torchrl.sim.shapes import Color, Solid
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.clearance import half_gap_m, outline_clearance_m
from ba_torchrl.tasks.footprints import Rectangle
from ba_torchrl.tasks.grasps import TopDownGrasp
from ba_torchrl.tasks.packing.base import RELEASE_GAP_M, PackingTask, open_box
from ba_torchrl.tasks.packing.layout import Footprint, random_rectangle, scatter
from ba_torchrl.tasks.pick_place_commands import no_op, pick_command
from ba_torchrl.tasks.structures.blueprint import UPRIGHT_RAD

TRAY_M = (0.24, 0.16, 0.05)
WALL_M = 0.01
FLOOR_M = 0.005

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
"""Radius and height of the corners of each bottle's profile, centimetres at the appendix's size;
the uppermost part is straight, for fingers to close on."""
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
"""Height of a bottle's centre of mass: it rights itself from a lean of 45 degrees."""
BOTTLE_M = 0.05
APART_M = 0.096
"""Between the middles of bottles, and of bottles and slots, at the start."""
STANDING_M = 0.003
"""A bottle stands in the tray if it is no farther above its floor."""
GRASP_YAWS = 8
CLEARANCE_M = 0.003
"""Gap wanted between a bottle in the tray and its neighbours."""
SEARCH_M = 0.01
LAYOUTS = 20


def slots() -> list[tuple[float, float]]:
    """Return where bottles go in the tray's frame, at the appendix's size."""
    length, width, _ = TRAY_M
    return [(x, y) for y in (-width / 4, width / 4) for x in (-length / 3, 0.0, length / 3)]


@TASKS.register("open_loop/bottle_arrangement")
class BottleArrangement(PackingTask):
    """Six of eight kinds of bottles and a tray; success when all stand in it, let go of.

    A bottle that falls over ends the episode.
    """

    scale_limits = (0.4, 0.8)
    max_steps = 20
    num_objects = 6
    num_objects_range = (6, 6)
    finger_opening = 0.8

    def load_scene(self) -> None:
        """Load the tray, and as many bottles of each kind as may be drawn."""
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
        """Put the tray anywhere, and random bottles around it."""
        count = self.settings.num_objects
        length, width, _ = (size * self.unit for size in TRAY_M)
        half = BOTTLE_M * self.unit / 2
        room = Footprint(half, half, margin_m=(APART_M - BOTTLE_M) * self.unit)
        for attempt in range(LAYOUTS):
            tray = random_rectangle(self, rng, length / 2, width / 2)
            # no bottle starts closer to the tray than to a bottle in it
            reserved = tray.resized(length / 3 + half, width / 4 + half)
            try:
                places = scatter(self, rng, [room] * count, [reserved])
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
        """Return whether every bottle stands in the tray, released."""
        return {
            "is_released": self.robot.held_body() not in self.objects,
            "is_arranged": all(map(self.stands_in_tray, self.objects)),
        }

    def is_valid(self) -> bool:
        """Whether all is inside the workspace, and no bottle fell over."""
        held = self.robot.held_body()
        return super().is_valid() and all(
            body is held or body.tilt_rad < UPRIGHT_RAD for body in self.objects
        )

    def stands_in_tray(self, body: Body) -> bool:
        """Whether a bottle stands on the tray's floor."""
        floor = self._floor_z_m()
        return (
            body.tilt_rad < UPRIGHT_RAD
            and abs(body.position[2] - floor) <= STANDING_M
            and self._inside().contains(np.array([body.position]))
        )

    def expert_command(self) -> PickPlaceCommand:
        """Stand a bottle that is not in the tray in its next free slot."""
        held = self.robot.held_body()
        if held is not None:
            x, y = self._free_place(held)
            floor = self._floor_z_m()
            yaw = self.robot.tool_pose()[1]
            if self.action_limits.turn_rad:
                others = self.obstacles(held, floor + self.depth_m(held) + self.tips_m)
                half = self.release_half_m(held)
                yaw = max(
                    self._yaws(),
                    key=lambda option: round(self._finger_gap_m((x, y), option, half, others), 4),
                )
            turn = yaw - self.robot.tool_pose()[1]
            return self.place(held, (x, y, floor + RELEASE_GAP_M), turn)
        outside = [body for body in self.objects if not self.stands_in_tray(body)]
        if not outside:
            return no_op(self.settings.workspace, is_holding=False)
        grasps = {body: self.grasp(body) for body in outside}
        place = self._free_place(None)
        if self._clearance(place, None) < CLEARANCE_M:
            # bottles stand where there is no room left: one of them goes to a better place
            grasps = {body: self.grasp(body) for body in self.objects if body not in grasps}
            body = max(grasps, key=lambda body: (grasps[body].clearance_m > 0, self._offset(body)))
            return pick_command(grasps[body].tool)
        body = max(outside, key=lambda body: round(grasps[body].clearance_m, 4))
        return pick_command(grasps[body].tool)

    def grasp(self, body: Body) -> TopDownGrasp:
        """Return where to grasp a bottle: by its neck, from the side with most room."""
        height = self.pick_height_m(vertical_extent(body)[1], body.position[:2])
        others = self.obstacles(body, height + self.tips_m)
        x, y, _ = body.position
        half = half_gap_m(self.robot.gripper, self.finger_opening)
        choices = [
            TopDownGrasp(body, (x, y, height), yaw, self._finger_gap_m((x, y), yaw, half, others))
            for yaw in self._yaws()
        ]
        return max(choices, key=lambda choice: round(choice.clearance_m, 4))

    # ----------------------------------------------------------------------------------------

    def _finger_gap_m(
        self,
        xy: tuple[float, float],
        yaw_rad: float,
        half_opening_m: float,
        others: Sequence[Rectangle],
    ) -> float:
        """Return the gap between the fingers at a place and the outlines of others."""
        tool = PlanarFrame(*xy, yaw_rad)
        return outline_clearance_m(self.robot.gripper, tool, half_opening_m, others)

    def _yaws(self) -> list[float]:
        """Return the yaws to grasp or let go of a bottle at, a diagonal of the tray first."""
        if not self.action_limits.turn_rad:
            return [0.0]
        first = self.container.yaw_rad + math.pi / 4
        return [first + math.pi * i / GRASP_YAWS for i in range(GRASP_YAWS)]

    def _tray(self) -> Rectangle:
        x, y, _ = self.container.position
        length, width, _ = (size * self.unit for size in TRAY_M)
        return Rectangle(x, y, self.container.yaw_rad, length / 2, width / 2)

    def _floor_z_m(self) -> float:
        """Return the height of the tray's floor."""
        return self.container.position[2] + (FLOOR_M - TRAY_M[2] / 2) * self.unit

    def _inside(self) -> Rectangle:
        """Return the tray's floor."""
        tray, wall = self._tray(), WALL_M * self.unit
        return tray.resized(tray.half_x - wall, tray.half_y - wall)

    def _offset(self, body: Body) -> float:
        """Return how far a bottle is from the nearest slot."""
        tray = self._tray()
        return min(
            math.dist(body.position[:2], tray.frame.to_world(x * self.unit, y * self.unit))
            for x, y in slots()
        )

    def _clearance(self, place: tuple[float, float], held: Body | None) -> float:
        """Return the gap between a bottle in the tray and those that stand there."""
        return min(
            (
                math.dist(place, body.position[:2]) - BOTTLE_M * self.unit
                for body in self.objects
                if body is not held
            ),
            default=math.inf,
        )

    def _free_place(self, held: Body | None) -> tuple[float, float]:
        """Return the first free slot, or the place in the tray with most room."""
        tray = self._tray()
        places = [tray.frame.to_world(x * self.unit, y * self.unit) for x, y in slots()]
        for place in places:
            if self._clearance(place, held) >= CLEARANCE_M:
                return place
        inside, half = self._inside(), BOTTLE_M * self.unit / 2 + CLEARANCE_M
        along, across = inside.half_x - half, inside.half_y - half
        places += [
            tray.frame.to_world(x, y)
            for x in np.arange(-along, along + 1e-9, SEARCH_M).tolist()
            for y in np.arange(-across, across + 1e-9, SEARCH_M).tolist()
        ]
        return max(places, key=lambda place: self._clearance(place, held))
