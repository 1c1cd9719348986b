"""Covid Test: present a swab and a tube, three times, and collect the used tubes (appendix A.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from ba_torchrl.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.errors import PlacementError
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.contacts import gap_m
from ba_torchrl.sim.geometry import PlanarFrame, YawPose, downward_pose
from ba_torchrl.sim.shapes import Box, Color
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.tasks.body_pool import move_out_of_scene
from ba_torchrl.tasks.clearance import grasp_clearance_m
from ba_torchrl.tasks.motion_primitives import RELEASE_GAP_M
from ba_torchrl.tasks.open_loop_task import OpenLoopTask
from ba_torchrl.tasks.pick_place_commands import no_op, pick_command, place_command

PURPLE: Color = (0.6, 0.45, 0.78, 1.0)
GRAY: Color = (0.6, 0.6, 0.6, 1.0)
YELLOW: Color = (0.93, 0.8, 0.3, 1.0)
GLASS: Color = (0.35, 0.7, 0.85, 1.0)
WHITE: Color = (0.97, 0.95, 0.92, 1.0)

SHEET_M = 2e-3
"""Height of the test area and of the floors of both boxes."""
WALL_M = 4e-3
SUNK_M = 0.05
"""Boxes reach down below the ground: what falls fast passes through a thin sheet."""
HALF_LAYOUT_M = 0.15
"""The three areas together fill a square of twice this."""
TIPS_GAP_M = 9e-4
"""Gap between what an object lies on and the tips of the fingers as they close."""
COLUMN_M = 0.05
"""Distance of neighbours in the box of new tubes; the fingers pass between them."""
WINDOW_M = 0.01
RIM_WINDOW_M = 0.052
"""From the middle of the box of used tubes, the next wall is within this."""

SPOT_ATTEMPTS = 50
APART_M = 3e-3
"""Gap between a tube that a test was made with and all else."""
REST_STEPS = 20


class Area(NamedTuple):
    """One of the three areas."""

    name: str
    color: Color
    center: tuple[float, float]
    """In the frame of the layout, metres."""
    size: tuple[float, float, float]


NEW_BOX = Area("box of new tubes", PURPLE, (-0.06, 0.055), (0.18, 0.19, 0.01))
USED_BOX = Area("box of used tubes", YELLOW, (-0.09, -0.1), (0.12, 0.1, 0.04))
TEST_AREA = Area("test area", GRAY, (0.0925, 0.0), (0.115, 0.3, SHEET_M))
AREAS = (NEW_BOX, USED_BOX, TEST_AREA)

TEST_SPOTS = tuple((0.0, y) for y in (0.0, 0.085, -0.085, 0.0425, -0.0425))
"""Where the expert presents, in the frame of the test area; the first free one."""
USED_ROWS = tuple((0.0, y) for y in (0.0, 0.024, -0.024))
"""Where it drops used tubes that lie along the box, in the box's frame."""
USED_COLUMNS = tuple((x, 0.0) for x in (0.0, 0.03, -0.03))
"""The same for tubes that lie across it."""


class CovidState(NamedTuple):
    """What the task remembers."""

    seed: int
    used: tuple[int, ...]
    """Tubes that a test was made with, by their index."""
    spent: tuple[int, ...]
    """Swabs that are gone."""
    has_failed: bool


@TASKS.register("open_loop/covid_test")
class CovidTest(OpenLoopTask):
    """Three tests for Covid; success when all tubes are in the box for used ones, the swabs gone.

    A tube and a swab, presented together in the test area, become one test: the swab disappears in
    the tube, and the tube lies anywhere in the test area. Before the next test it must be in the
    box for used tubes. What breaks this order ends the episode: a second tube or a second swab in
    the test area, or a swab and a tube there before the last tube was collected.
    """

    scale_limits = (0.5, 0.66)
    max_steps = 30
    num_objects = 6
    num_objects_range = (6, 6)
    rounds: ClassVar[int] = 3
    finger_opening = 0.35

    tube_m: ClassVar[tuple[float, float]] = (0.08, 0.017)
    """Length and width at the default scale."""
    swab_m: ClassVar[tuple[float, float]] = (0.07, 0.01)
    turn_rad: ClassVar[float] = math.radians(18.5)
    """The layout deviates by at most this from right angles to the workspace; it still fits."""
    skew_rad: ClassVar[float] = math.radians(20)
    """Tubes and swabs in their box deviate by at most this from its long side."""
    spot_m: ClassVar[tuple[float, float]] = (0.0125, 0.1)
    """A used tube turns up within this of the middle of the test area."""

    def load_scene(self) -> None:
        """Load the three areas, the tubes and the swabs."""
        floors = [self.world.add(_slab(area, area.size[:2], SHEET_M), area.name) for area in AREAS]
        self.new_box, self.used_box, self.test_area = floors
        self._slabs = [(area, (0.0, 0.0), floor) for area, floor in zip(AREAS, floors, strict=True)]
        self._walls: list[Body] = []
        for area in (NEW_BOX, USED_BOX):
            for place, size in _walls(area):
                wall = self.world.add(_slab(area, size, area.size[2]), f"wall of the {area.name}")
                self._slabs.append((area, place, wall))
                self._walls.append(wall)
        factor = self.settings.scale / self.scale_range[0]
        self._tube_m, self._swab_m = (
            (factor * length, factor * width) for length, width in (self.tube_m, self.swab_m)
        )
        (tube_m, tube_width_m), (swab_m, swab_width_m) = self._tube_m, self._swab_m
        tube = Box(size_m=(tube_m, tube_width_m, tube_width_m), mass_kg=0.05, color=GLASS)
        swab = Box(size_m=(swab_m, swab_width_m, swab_width_m), mass_kg=0.03, color=WHITE)
        self.tubes = [self.world.add(tube, f"tube {i + 1}") for i in range(self.rounds)]
        self.swabs = [self.world.add(swab, f"swab {i + 1}") for i in range(self.rounds)]
        self._used: list[Body] = []
        self._spent: list[Body] = []
        self._seed = 0
        self.has_failed = False
        """Whether the order of the test was broken."""

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Put the layout anywhere, mirrored or not, with all tubes and swabs in their box.

        With fixed orientations the layout is turned by 0 or 180 degrees, and all lies along y.
        """
        self._used, self._spent, self.has_failed = [], [], False
        self._seed = int(rng.integers(2**63))
        is_turned = self.settings.random_orientation
        yaw = math.pi / 2 * float(rng.integers(4) if is_turned else 2 * rng.integers(2))
        yaw += self.random_yaw(rng, 2 * self.turn_rad)
        mirror = 1.0 if rng.random() < 0.5 else -1.0
        half = HALF_LAYOUT_M * (abs(math.cos(yaw)) + abs(math.sin(yaw)))
        center = self.random_point(rng, 2 * half)
        for area, place, body in self._slabs:
            x, y = area.center
            middle = PlanarFrame(*center, yaw).to_world(mirror * x, y)
            xy = PlanarFrame(*middle, yaw).to_world(*place)
            z = self.terrain.height_m(xy) - SUNK_M - body.shape.bounds_m[0][2]
            body.place((*xy, z), yaw)
        rows = self._rows()
        for bodies, row in ((self.tubes, rows[0]), (self.swabs, rows[1])):
            for column, body in zip(self._columns(), bodies, strict=True):
                body.is_hidden = False
                along = self.new_box.yaw_rad if is_turned else 0.0
                along += math.pi / 2 + self.random_yaw(rng, 2 * self.skew_rad)
                if is_turned:
                    along += math.pi * float(rng.integers(2))
                self._lay(body, self._to_world(self.new_box, (column, row)), along)

    def after_action(self) -> None:
        """Make the test that was asked for, if any, or take note that the order was broken."""
        tubes = [tube for tube in self.tubes if self._is_presented(tube)]
        swabs = [swab for swab in self.swabs if self._is_presented(swab)]
        if len(tubes) == len(swabs) == 1:
            if self._uncollected():
                self.has_failed = True
            else:
                self._test(tubes[0], swabs[0])
        elif max(len(tubes), len(swabs)) > 1:
            self.has_failed = True

    def evaluate(self) -> dict[str, bool]:
        """Return whether all tests are made and all tubes are in the box for used ones."""
        return {
            "is_tested": len(self._spent) == self.rounds,
            "is_collected": all(map(self.is_collected, self.tubes)),
        }

    def is_valid(self) -> bool:
        """Whether the order of the test was kept and all is inside the workspace."""
        return not self.has_failed and super().is_valid()

    def is_collected(self, tube: Body) -> bool:
        """Whether a tube lies in the box for used ones, below its rim."""
        length, width, rim = USED_BOX.size
        inner = (length - 2 * WALL_M, width - 2 * WALL_M)
        is_below_rim = tube.position[2] - self.terrain.height_m(tube.position[:2]) < rim
        return is_below_rim and self._is_on(self.used_box, inner, tube)

    @property
    def objects(self) -> Sequence[Body]:
        """The tubes, and the swabs that are left."""
        return [*self.tubes, *(swab for swab in self.swabs if swab not in self._spent)]

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """Areas, tubes and swabs; in place of swabs that are gone, the workspace's upper corner."""
        workspace = self.settings.workspace
        gone = ((workspace.x[1], workspace.y[1], workspace.z[1]), 0.0)
        return [
            gone if body in self._spent else (body.position, body.yaw_rad)
            for body in (self.new_box, self.used_box, self.test_area, *self.tubes, *self.swabs)
        ]

    def get_state(self) -> CovidState:
        """Return how far the tests are, and what the coming ones follow from."""
        return CovidState(
            self._seed,
            tuple(self.tubes.index(tube) for tube in self._used),
            tuple(self.swabs.index(swab) for swab in self._spent),
            self.has_failed,
        )

    def set_state(self, state: CovidState) -> None:
        """Take up what `get_state` returned; which bodies are hidden is the scene's to restore."""
        self._seed, used, spent, self.has_failed = state
        self._used = [self.tubes[i] for i in used]
        self._spent = [self.swabs[i] for i in spent]

    # -- heights that an action leaves open --------------------------------------------------

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool at which the fingers close on what lies highest there."""
        return max(top_m - self._tube_m[1] / 2, self._sheet_z_m(xy) + self._grasp_m)

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        """Return the height of the tool at which what was picked like this is let go."""
        return top_m + self._grasp_m + RELEASE_GAP_M

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the square that is searched for the highest point.

        With a tube in the hand it takes in the rim of a box: fingers and tube stay above.
        """
        return RIM_WINDOW_M if held in self.tubes else WINDOW_M

    # -- the test ----------------------------------------------------------------------------

    def _test(self, tube: Body, swab: Body) -> None:
        """Put the swab into the tube: it is gone, and the tube lies anywhere in the test area."""
        move_out_of_scene(swab, self.swabs.index(swab))
        self._spent.append(swab)
        self._used.append(tube)
        # keyed on the round: what happened before has no part in it
        rng = np.random.default_rng([self._seed, len(self._used)])
        others = [other for other in self.objects if other is not tube]
        for _ in range(SPOT_ATTEMPTS):
            spot = tuple(float(rng.uniform(-half, half)) for half in self.spot_m)
            yaw = math.pi / 2 + self.random_yaw(rng, 2 * math.pi)
            self._lay(tube, self._to_world(self.test_area, spot), yaw)
            if all(gap_m(self.world.client, other.id, tube.id) > APART_M for other in others):
                break
        self.world.settle(max_steps=REST_STEPS)

    def _uncollected(self) -> list[Body]:
        return [tube for tube in self._used if not self.is_collected(tube)]

    def _is_presented(self, body: Body) -> bool:
        return body not in self._spent and self._is_on(self.test_area, TEST_AREA.size, body)

    def _is_on(self, area: Body, size_m: Sequence[float], body: Body) -> bool:
        """Whether a body, let go of, has its centre above a rectangle about an area's centre."""
        if body is self.robot.held_body():
            return False
        frame = PlanarFrame(*area.position[:2], area.yaw_rad)
        local = frame.to_local(*body.position[:2])
        return all(abs(place) < extent / 2 for place, extent in zip(local, size_m, strict=False))

    # -- the expert --------------------------------------------------------------------------

    def expert_command(self) -> PickPlaceCommand:
        """Collect a used tube, else present what is missing for a test, from any state."""
        held = self.robot.held_body()
        if held is not None:
            return self._place(held)
        wanted = self._wanted()
        if not wanted:
            return no_op(self.settings.workspace, is_holding=False)
        body = max(wanted, key=self._room)
        x, y, _ = body.position
        z = vertical_extent(body)[0] + self._grasp_m
        return pick_command(downward_pose((x, y, z), self._grasp_yaw(body)))

    def _wanted(self) -> list[Body]:
        """Return the bodies any of which is to be picked next."""
        uncollected = self._uncollected()
        if uncollected:
            return uncollected
        if any(map(self._is_presented, self.tubes)):
            return [swab for swab in self.swabs if swab not in self._spent]
        fresh = [tube for tube in self.tubes if tube not in self._used]
        # one that strayed among the used first, before others lie beside it
        return [tube for tube in fresh if self.is_collected(tube)] or fresh

    def _place(self, held: Body) -> PickPlaceCommand:
        """Return the place that brings what is held to where it goes."""
        if held in self._used:
            turns = bool(self.action_limits.turn_rad)
            spots = USED_ROWS if turns else USED_COLUMNS
            rim_m = self.terrain.height_m(self.used_box.position[:2]) + USED_BOX.size[2]
            return self._place_on(held, self.used_box, spots, 0.0, rim_m=rim_m)
        kin = self.tubes if held in self.tubes else self.swabs
        if self._uncollected() or any(map(self._is_presented, kin)):
            row = self._rows()[0 if kin is self.tubes else 1]
            spots = [(column, row) for column in self._columns()]
            return self._place_on(held, self.new_box, spots, math.pi / 2)
        return self._place_on(held, self.test_area, TEST_SPOTS, math.pi / 2)

    def _place_on(
        self,
        held: Body,
        area: Body,
        spots: Sequence[tuple[float, float]],
        along_rad: float,
        rim_m: float = -math.inf,
    ) -> PickPlaceCommand:
        """Return the place of what is held on the spot of an area that has most room.

        Args:
            held: what is in the gripper.
            area: where it goes.
            spots: in the frame of the area.
            along_rad: how it is to lie in that frame; a gripper that cannot turn leaves it.
            rim_m: height that the fingertips stay above.
        """
        tool = self.robot.tool_frame()
        others = [other.position for other in self.objects if other is not held]
        x, y = max(
            (self._to_world(area, spot) for spot in spots),
            key=lambda spot: min(math.dist(spot, other[:2]) for other in others),
        )
        turn = -tool.yaw_rad
        if self.action_limits.turn_rad:
            turn = wrap_angle(area.yaw_rad + along_rad - held.yaw_rad, math.pi)
        z = self._sheet_z_m((x, y)) + RELEASE_GAP_M + held.position[2] - vertical_extent(held)[0]
        command = place_command(tool, held.pose, held.pose.moved_to((x, y, z), turn))
        return command._replace(z_m=max(command.z_m, rim_m + self._grasp_m + RELEASE_GAP_M))

    @property
    def _grasp_m(self) -> float:
        """Height of the tool above what an object lies on, for the lower part of a swab."""
        return TIPS_GAP_M - self.robot.gripper.lowest_tip_m

    def _grasp_yaw(self, body: Body) -> float:
        return body.yaw_rad + math.pi / 2 if self.action_limits.turn_rad else 0.0

    def _room(self, body: Body) -> float:
        others = [other for other in self.objects if other is not body] + self._walls
        yaw = self._grasp_yaw(body)
        return grasp_clearance_m(self.robot.gripper, body, yaw, others, self.finger_opening)

    # -- places ------------------------------------------------------------------------------

    def _rows(self) -> tuple[float, float]:
        """Return where along the box of new tubes the tubes and the swabs have their middle."""
        inner = NEW_BOX.size[1] / 2 - WALL_M
        tube, swab = self._tube_m[0], self._swab_m[0]
        gap = (2 * inner - tube - swab) / 3
        if gap < APART_M:
            raise PlacementError(
                f"tubes of {tube:.3f} m and swabs of {swab:.3f} m do not fit into their box: lower "
                "`object_scale_range`"
            )
        return inner - gap - tube / 2, gap + swab / 2 - inner

    def _columns(self) -> list[float]:
        return [(i - (self.rounds - 1) / 2) * COLUMN_M for i in range(self.rounds)]

    def _to_world(self, area: Body, spot: tuple[float, float]) -> tuple[float, float]:
        return PlanarFrame(*area.position[:2], area.yaw_rad).to_world(*spot)

    def _lay(self, body: Body, xy: tuple[float, float], yaw_rad: float) -> None:
        """Put a tube or swab on the floor of an area."""
        body.place((*xy, self._sheet_z_m(xy) - body.shape.bounds_m[0][2]), yaw_rad)

    def _sheet_z_m(self, xy: tuple[float, float]) -> float:
        """Return the height of the floors of the areas."""
        return self.terrain.height_m(xy) + SHEET_M


def _slab(area: Area, size_m: tuple[float, float], top_m: float) -> Box:
    return Box(size_m=(*size_m, top_m + SUNK_M), mass_kg=0, color=area.color)


def _walls(area: Area) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return the place, in the area's frame, and the size of each wall of a box.

    They are boxes, each a body of its own: things creep on a body of several convex hulls.
    """
    (x, y, _), wall = area.size, WALL_M
    sides = [((0.0, (y - wall) / 2), (x - 2 * wall, wall)), (((x - wall) / 2, 0.0), (wall, y))]
    return [((sign * px, sign * py), size) for (px, py), size in sides for sign in (-1.0, 1.0)]
