"""Box Palletizing: stack boxes on a pallet, in layers that cross each other (appendix A.1)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ba_torchrl.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.errors import PlacementError
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.shapes import Box
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.body_pool import BodyPool
from ba_torchrl.tasks.footprints import Rectangle, gap_m, narrowest, outline
from ba_torchrl.tasks.packing.base import ENOUGH_M, RELEASE_GAP_M, PackingTask
from ba_torchrl.tasks.packing.layout import Footprint, random_rectangle, scatter
from ba_torchrl.tasks.pick_place_commands import no_op, pick_command
from ba_torchrl.tasks.structures.blueprint import CUBOID, UPRIGHT_RAD

PALLET_M = (0.232, 0.192, 0.03)
BOX_M = (0.045, 0.072, 0.045)
"""Its length is along y."""
PER_LAYER = 6
ROW_M = 0.067
"""Between the middles of boxes side by side: fingers fit between them."""
COLUMN_M = 0.088
"""Between the middles of boxes end to end."""
PATTERN_M = 2 * ROW_M + BOX_M[0]
"""Width of a layer, the greater of the two."""
SLOT_M = 0.01
"""A box is in a slot if along neither side of the pallet it is farther off than this."""
SLOT_RAD = math.pi / 8
GRIP_M = 0.008
"""Boxes are held this far below their top, where fingers fit between their neighbours."""
NEIGHBOR_GAP_M = 0.019
"""Between boxes side by side a finger fits that lets go."""
SHIFTS = (0.0, 0.3, -0.3, 0.6, -0.6)
"""Where in a slot a box may go, as a multiple of what is tolerated."""
TIP_OVER_M = 0.008
"""A box that stands on its end is set down with its middle this far beyond the pallet's edge."""
TIP_PLACES = 2
FREE_HALF_M = (0.056, 0.016)
"""Half the extents of the area around an object that is free at the start, for the pick."""
SETTLE_STEPS = 100
LAYOUTS = 20


def slots(layer: int) -> list[tuple[float, float, float]]:
    """Return x, y and yaw of the slots of a layer in the pallet's frame, at the appendix's size.

    Two columns of three lie along the pallet; every other layer is turned by a quarter.
    """
    places = [(side * COLUMN_M / 2, row * ROW_M) for side in (1, -1) for row in (-1, 0, 1)]
    if layer % 2 == 0:
        return [(x, y, math.pi / 2) for x, y in places]
    return [(-y, x, 0.0) for x, y in places]


@TASKS.register("open_loop/box_palletizing")
class BoxPalletizing(PackingTask):
    """Boxes that come one by one go onto a pallet; success when all layers are full.

    A box counts if it lies in a slot of a layer under which all are full. The next one comes
    when all that came before count and nothing is held.
    """

    scale_limits = (0.75, 1.0)
    max_steps = 40
    num_objects = 18
    num_objects_range = (6, 18)
    num_objects_step = PER_LAYER

    def load_scene(self) -> None:
        """Load the pallet and all boxes."""
        pallet, box = (tuple(s * self.unit for s in size) for size in (PALLET_M, BOX_M))
        color = (0.55, 0.42, 0.28, 1.0)
        self.container = self.world.add(Box(size_m=pallet, mass_kg=0.0, color=color), "pallet")
        shape = Box(size_m=box, color=(0.85, 0.66, 0.4, 1.0))
        count = self.settings.num_objects
        self.pool = BodyPool(self.world, [shape] * count, [f"box {i + 1}" for i in range(count)])
        self._arrivals: list[tuple[tuple[float, float], float]] = []
        """Where each box comes in."""

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Put the pallet anywhere, and the first box beside it."""
        half_x, half_y, _ = (size * self.unit / 2 for size in PALLET_M)
        width, length, _ = (size * self.unit / 2 for size in BOX_M)
        hand = tuple(size * self.unit for size in FREE_HALF_M)
        room = Footprint(width, length, *hand)
        for attempt in range(LAYOUTS):
            pallet = random_rectangle(self, rng, half_x, half_y, fixed_yaw_rad=math.pi / 2)
            try:
                stack = pallet.resized(PATTERN_M * self.unit / 2, PATTERN_M * self.unit / 2)
                self._arrivals = [
                    scatter(self, rng, [room], [pallet], clear_of=stack)[0]
                    for _ in range(self.settings.num_objects)
                ]
                break
            except PlacementError:
                if attempt == LAYOUTS - 1:
                    raise
        self.stand(self.container, (pallet.x, pallet.y), pallet.yaw_rad)
        self.pool.clear()
        self._bring()

    def after_action(self) -> None:
        """Bring a new box once all that are there lie where they belong."""
        present = len(self.pool.present)
        if present == self.settings.num_objects or self.robot.held_body() is not None:
            return
        if len(self.filled()) == present:
            self._bring()
            self.world.settle(SETTLE_STEPS)

    def evaluate(self) -> dict[str, bool]:
        """Return whether every slot has its box, released."""
        return {"is_stacked": len(self.filled()) == self.settings.num_objects}

    def filled(self) -> dict[tuple[int, int], Body]:
        """Return the boxes that count, by layer and number of their slots."""
        held, pallet = self.robot.held_body(), self._pallet()
        found: dict[tuple[int, int], Body] = {}
        for body in self.pool.present:
            slot = None if body is held else self._slot_of(body, pallet)
            if slot is not None:
                found[slot] = body
        full = 0
        while all((full, number) in found for number in range(PER_LAYER)):
            full += 1
        return {slot: body for slot, body in found.items() if slot[0] <= full}

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height at which a box is held."""
        return max(top_m - GRIP_M * self.unit, self.lowest_tool_m(xy))

    def get_state(self) -> Any:
        """Return which boxes are there, and where the others will come in."""
        return super().get_state(), list(self._arrivals)

    def set_state(self, state: Any) -> None:
        """Take up what `get_state` returned."""
        present, self._arrivals = state
        super().set_state(present)

    def expert_command(self) -> PickPlaceCommand:
        """Put the box that lies highest among those that do not count into the next slot."""
        held = self.robot.held_body()
        filled = self.filled()
        if held is not None:
            return self._place_in_slot(held, filled)
        astray = [body for body in self.pool.present if body not in filled.values()]
        if not astray:
            return no_op(self.settings.workspace, is_holding=False)
        grasps = {body: self.grasp(body) for body in astray}

        def urgency(body: Body) -> tuple[float, bool, float]:
            level = round(vertical_extent(body)[1] / (BOX_M[2] * self.unit / 2))
            return level, grasps[body].clearance_m > 0, grasps[body].clearance_m

        body = max(astray, key=urgency)
        return pick_command(grasps[body].tool)

    # ----------------------------------------------------------------------------------------

    def _bring(self) -> None:
        number = len(self.pool.present)
        box = self.pool.bodies[number]
        self.pool.activate(box)
        self.stand(box, *self._arrivals[number])

    def _pallet(self) -> Rectangle:
        x, y, _ = self.container.position
        half_x, half_y, _ = (size * self.unit / 2 for size in PALLET_M)
        return Rectangle(x, y, self.container.yaw_rad, half_x, half_y)

    def _level_z_m(self, layer: int) -> float:
        """Return the height of the middle of a layer's boxes."""
        base = self.container.position[2] + PALLET_M[2] * self.unit / 2
        return base + (layer + 0.5) * BOX_M[2] * self.unit

    def _slot_of(self, body: Body, pallet: Rectangle) -> tuple[int, int] | None:
        """Return layer and number of the slot that a box lies in, if any."""
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
            off = max(abs(along - slot_x * self.unit), abs(across - slot_y * self.unit))
            if off <= SLOT_M * self.unit:
                is_along = abs(wrap_angle(heading - yaw, math.pi)) <= SLOT_RAD
                return (layer, number) if is_along else None
        return None

    def _place_in_slot(self, held: Body, filled: dict[tuple[int, int], Body]) -> PickPlaceCommand:
        """Return the place into the first slot that is free; else onto the floor."""
        if CUBOID.tilt_rad(held) > math.pi / 4:
            return self._tip_over(held)
        layer = min(len(filled) // PER_LAYER, self.settings.num_objects // PER_LAYER - 1)
        pallet, heading = self._pallet(), CUBOID.yaw_rad(held)
        width, length, height = (size * self.unit / 2 for size in BOX_M)
        z = self._level_z_m(layer) + RELEASE_GAP_M
        astray = [
            outline(body)
            for body in self.pool.present
            if body is not held and body not in filled.values()
        ]
        beside = [outline(body) for slot, body in filled.items() if slot[0] == layer]
        for number, (x, y, yaw) in enumerate(slots(layer)):
            if (layer, number) in filled:
                continue
            middle = Rectangle(
                *pallet.frame.to_world(x * self.unit, y * self.unit),
                pallet.yaw_rad + yaw,
                width,
                length,
            )
            spots = [
                Rectangle(*middle.frame.to_world(shift * SLOT_M * self.unit, 0.0), *middle[2:])
                for shift in SHIFTS
            ]
            # a neighbour may lie at the edge of its slot, where a finger should go
            spot = max(
                spots,
                key=lambda spot: (
                    min((gap_m(spot, other) for other in beside), default=math.inf)
                    > NEIGHBOR_GAP_M * self.unit
                ),
            )
            if all(gap_m(spot, other) > 0 for other in astray):
                return self.place(held, (spot.x, spot.y, z), spot.yaw_rad - heading)
        (x, y), yaw = max(self._arrivals, key=lambda arrival: self._room_at(arrival, held))
        z = self.terrain.height_m((x, y)) + height + RELEASE_GAP_M
        return self.place(held, (x, y, z), yaw - heading)

    def _tip_over(self, held: Body) -> PickPlaceCommand:
        """Return the place at the pallet's edge from which a box that stands on its end falls."""
        pallet, own = self._pallet(), narrowest(held, self.robot.tool_pose()[1])[0]
        width, length, _ = (size * self.unit / 2 for size in BOX_M)
        others = [outline(body) for body in self.pool.present if body is not held]
        workspace = self.settings.workspace
        best: tuple[float, tuple[float, float]] | None = None
        for side in (-1, 1):
            for along in range(-TIP_PLACES, TIP_PLACES + 1):
                across = along / (TIP_PLACES + 1) * (pallet.half_y - width)
                edge = side * pallet.half_x
                falls = Rectangle(
                    *pallet.frame.to_world(edge + side * (length + 2 * TIP_OVER_M), across),
                    pallet.yaw_rad,
                    length + 2 * TIP_OVER_M,
                    width,
                )
                room = min((gap_m(falls, other) for other in others), default=ENOUGH_M)
                inside = 1.0 if falls.is_inside(workspace) else 0.0
                spot = pallet.frame.to_world(edge + side * TIP_OVER_M, across)
                if best is None or inside + min(room, ENOUGH_M) > best[0]:
                    best = (inside + min(room, ENOUGH_M), spot)
        z = self._level_z_m(0) - BOX_M[2] * self.unit / 2 + RELEASE_GAP_M
        z += held.position[2] - vertical_extent(held)[0]
        # the fingers close along the edge, out of its way
        return self.place(held, (*best[1], z), pallet.yaw_rad + math.pi / 2 - own.yaw_rad)

    def _room_at(self, arrival: tuple[tuple[float, float], float], held: Body) -> float:
        """Return the gap between a place on the floor and the boxes that are there."""
        width, length, _ = (size * self.unit / 2 for size in BOX_M)
        spot = Rectangle(*arrival[0], arrival[1], width, length)
        others = [outline(body) for body in self.pool.present if body is not held]
        return min((gap_m(spot, other) for other in others), default=math.inf)
