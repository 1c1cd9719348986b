"""Covid Test: present a swab and a tube, three times, and collect the used tubes (appendix A.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from ba_torchrl.core.actions import PickPlaceCommand, wrap_angle
from ba_torchrl.core.errors import PlacementError
from ba_torchrl.sim import contacts
from ba_torchrl.sim.bodies import Body, vertical_extent
from ba_torchrl.sim.geometry import PlanarFrame, YawPose, downward_pose
from ba_torchrl.sim.shapes import Box, Color
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.base import TASKS, OpenLoopTask
from ba_torchrl.tasks.body_pool import deactivate_body
from ba_torchrl.tasks.instructions import colored, counted
from ba_torchrl.tasks.manipulation.footprints import Rectangle, gap_m, outline
from ba_torchrl.tasks.manipulation.pick_place_commands import (
    no_op,
    perturbed_pick,
    pick_command,
    place_command,
)
from ba_torchrl.tasks.manipulation.transport import RELEASE_GAP_M
from ba_torchrl.tasks.terrain.flat import Terrain

PURPLE: Color = (0.6, 0.45, 0.78, 1.0)
GRAY: Color = (0.6, 0.6, 0.6, 1.0)
YELLOW: Color = (0.93, 0.8, 0.3, 1.0)

SHEET_M = 2e-3
"""Height of the test area, and of the floors of both boxes, above the ground."""
WALL_M = 4e-3
"""Thickness of the walls of both boxes."""
UNDERGROUND_M = 0.05
"""Depth of the boxes below the ground. Fast objects would pass through a thin sheet."""
HALF_LAYOUT_M = 0.15
"""Half the edge of the square that the three areas fill."""
COLUMN_M = 0.05
"""Distance between neighbours in the box of new tubes; the fingers fit between them."""
GAP_M = 3e-3
"""Least gap between tubes and swabs."""
GLASS: Color = (0.35, 0.7, 0.85, 1.0)
WHITE: Color = (0.97, 0.95, 0.92, 1.0)

TIPS_GAP_M = 9e-4
"""Gap between the support of an object and the tips of the closing fingers."""
WINDOW_M = 0.01
"""Half the width of the window that is searched for the highest point, without a tube."""
RIM_WINDOW_M = 0.052
"""The same with a tube: from the centre of the box of used tubes it contains a wall."""
LEANING_M = 5e-3
"""Height of a leaning tube or swab above its width."""
TUBE_ATTEMPTS = 50
"""Random poses of a used tube that are compared."""
REST_STEPS = 20
"""Largest number of physics steps until a used tube is at rest."""


class Area(NamedTuple):
    """One of the three areas."""

    name: str
    color: Color
    center: tuple[float, float]
    """In the frame of the layout, metres."""
    size: tuple[float, float, float]
    """Outer extents, metres."""


NEW_BOX = Area("box of new tubes", PURPLE, (-0.06, 0.055), (0.18, 0.19, 0.01))
USED_BOX = Area("box of used tubes", YELLOW, (-0.09, -0.1), (0.12, 0.1, 0.04))
TEST_AREA = Area("test area", GRAY, (0.0925, 0.0), (0.115, 0.3, SHEET_M))
AREAS = (NEW_BOX, USED_BOX, TEST_AREA)

TEST_SITES = tuple((0.0, y) for y in (0.0, 0.085, -0.085, 0.0425, -0.0425))
"""Positions in the frame of the test area at which the expert presents tubes and swabs."""
USED_ROWS = tuple((0.0, y) for y in (0.0, 0.024, -0.024))
"""Positions in the frame of the box of used tubes for tubes along its length."""
USED_COLUMNS = tuple((x, 0.0) for x in (0.0, 0.03, -0.03))
"""Positions in the frame of the box of used tubes for tubes across its length."""


class CovidLayout:
    """The three areas as static bodies of a world.

    Args:
        world: not sealed yet.
    """

    def __init__(self, world: World, terrain: Terrain) -> None:
        self.terrain = terrain
        floors = [world.add(_slab(area, area.size[:2], SHEET_M), area.name) for area in AREAS]
        self.new_box, self.used_box, self.test_area = floors
        self._slabs = [(area, (0.0, 0.0), floor) for area, floor in zip(AREAS, floors, strict=True)]
        self.walls: list[Body] = []
        """The walls of both boxes."""
        for area in (NEW_BOX, USED_BOX):
            for xy, size in _walls(area):
                wall = world.add(_slab(area, size, area.size[2]), f"wall of the {area.name}")
                self._slabs.append((area, xy, wall))
                self.walls.append(wall)

    def place(self, center: tuple[float, float], yaw_rad: float, mirror: float) -> None:
        """Place the layout.

        Args:
            mirror: -1 to mirror it along its x axis, else 1.
        """
        for area, xy, body in self._slabs:
            x, y = area.center
            area_xy = PlanarFrame(*center, yaw_rad).to_world(mirror * x, y)
            xy = PlanarFrame(*area_xy, yaw_rad).to_world(*xy)
            z = self.terrain.height_m(xy) - UNDERGROUND_M - body.shape.bounds_m[0][2]
            body.place((*xy, z), yaw_rad)

    def floor_z_m(self, xy: tuple[float, float]) -> float:
        """Return the height of the floors of the areas at a point."""
        return self.terrain.height_m(xy) + SHEET_M

    def to_world(self, area: Body, xy: tuple[float, float]) -> tuple[float, float]:
        """Return a point in the frame of an area as a point in the world."""
        return PlanarFrame(*area.position[:2], area.yaw_rad).to_world(*xy)

    def lay(self, body: Body, xy: tuple[float, float], yaw_rad: float) -> None:
        """Place a tube or swab on the floor of an area."""
        body.place((*xy, self.floor_z_m(xy) - body.shape.bounds_m[0][2]), yaw_rad)

    def is_above(self, area: Body, size_m: Sequence[float], body: Body) -> bool:
        """Whether the centre of a body is above a rectangle of a size around an area's centre."""
        frame = PlanarFrame(*area.position[:2], area.yaw_rad)
        local = frame.to_local(*body.position[:2])
        return all(abs(x) < extent / 2 for x, extent in zip(local, size_m, strict=False))

    def is_in_used_box(self, body: Body) -> bool:
        """Whether the centre of a body is in the box of used tubes, below its rim."""
        length, width, rim = USED_BOX.size
        inner = (length - 2 * WALL_M, width - 2 * WALL_M)
        is_below_rim = body.position[2] - self.terrain.height_m(body.position[:2]) < rim
        return is_below_rim and self.is_above(self.used_box, inner, body)

    @property
    def used_rim_m(self) -> float:
        """Height of the rim of the box of used tubes."""
        return self.terrain.height_m(self.used_box.position[:2]) + USED_BOX.size[2]


def new_rows(tube_m: float, swab_m: float) -> tuple[float, float]:
    """Return y of the centres of new tubes and of new swabs, in the frame of their box.

    Raises:
        PlacementError: they do not fit into the box.
    """
    inner = NEW_BOX.size[1] / 2 - WALL_M
    gap = (2 * inner - tube_m - swab_m) / 3
    if gap < GAP_M:
        raise PlacementError(
            f"tubes of {tube_m:.3f} m and swabs of {swab_m:.3f} m do not fit into their box: lower "
            "`object_scale_range`"
        )
    return inner - gap - tube_m / 2, gap + swab_m / 2 - inner


def new_columns(count: int) -> list[float]:
    """Return x of the centres of new tubes and swabs, in the frame of their box."""
    return [(i - (count - 1) / 2) * COLUMN_M for i in range(count)]


def _slab(area: Area, size_m: tuple[float, float], top_m: float) -> Box:
    return Box(size_m=(*size_m, top_m + UNDERGROUND_M), mass_kg=0, color=area.color)


def _walls(area: Area) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return position, in the frame of the area, and size of each wall of a box.

    Each wall is a body of its own, as objects creep on a body of several convex hulls.
    """
    (x, y, _), wall = area.size, WALL_M
    sides = [((0.0, (y - wall) / 2), (x - 2 * wall, wall)), (((x - wall) / 2, 0.0), (wall, y))]
    return [((sign * px, sign * py), size) for (px, py), size in sides for sign in (-1.0, 1.0)]


class CovidState(NamedTuple):
    """State of the task besides the poses of its bodies."""

    seed: int
    """Seed of the poses of the used tubes."""
    used_tubes: tuple[int, ...]
    """Indices of the tubes of all tests so far."""
    used_swabs: tuple[int, ...]
    """Indices of the swabs of all tests so far, which are no longer in the scene."""
    has_failed: bool


@TASKS.register("open_loop/covid_test")
class CovidTest(OpenLoopTask):
    """Objects: three tubes of 8 x 1.7 x 1.7 cm and three swabs of 7 x 1 x 1 cm in a box.

    Goal: three tests are made and all tubes are in the box of used tubes. A test is made when one
    tube and one swab lie in the test area: the swab is removed, and the tube is moved to a random
    pose in the test area, from which it must be collected before the next test. The episode ends
    early when a second tube or swab lies in the test area, when a tube and a swab lie there before
    the last tube is collected, or when an object leaves the workspace. Paper, appendix A.1.
    """

    expert_version = 1
    scale_limits = (0.5, 0.66)
    max_steps = 30
    num_objects = 6
    num_objects_range = (6, 6)
    rounds: ClassVar[int] = 3
    """Number of tests."""
    finger_opening = 0.35

    tube_m: ClassVar[tuple[float, float]] = (0.08, 0.017)
    """Length and width of a tube at the default scale, metres."""
    swab_m: ClassVar[tuple[float, float]] = (0.07, 0.01)
    """Length and width of a swab at the default scale, metres."""
    turn_rad: ClassVar[float] = math.radians(18.5)
    """Largest angle between the layout and the axes of the workspace, radians."""
    skew_rad: ClassVar[float] = math.radians(20)
    """Largest angle between new tubes or swabs and the long side of their box, radians."""
    used_half_m: ClassVar[tuple[float, float]] = (0.0125, 0.1)
    """Half the extents of the area in which used tubes appear, around the centre of the test area,
    metres."""

    def load_scene(self) -> None:
        """Load the layout, the tubes and the swabs."""
        self.layout = CovidLayout(self.world, self.terrain)
        factor = self.settings.scale / self.scale_range[0]
        self._tube_m, self._swab_m = (
            (factor * length, factor * width) for length, width in (self.tube_m, self.swab_m)
        )
        (tube_m, tube_width_m), (swab_m, swab_width_m) = self._tube_m, self._swab_m
        tube = Box(size_m=(tube_m, tube_width_m, tube_width_m), mass_kg=0.05, color=GLASS)
        swab = Box(size_m=(swab_m, swab_width_m, swab_width_m), mass_kg=0.03, color=WHITE)
        self.tubes = [self.world.add(tube, f"tube {i + 1}") for i in range(self.rounds)]
        self.swabs = [self.world.add(swab, f"swab {i + 1}") for i in range(self.rounds)]
        self._used_tubes: list[Body] = []
        self._used_swabs: list[Body] = []
        self._seed = 0
        self.has_failed = False
        """Whether the order of the tests was violated."""

    def initialize_episode(self, rng: np.random.Generator) -> None:
        """Place the layout at a random pose, with all tubes and swabs in their box.

        Half of the layouts are mirrored. With fixed orientations the yaw of the layout is 0 or 180
        degrees, and all objects lie along y.
        """
        self._used_tubes, self._used_swabs, self.has_failed = [], [], False
        self._seed = int(rng.integers(2**63))
        is_random = self.settings.random_orientation
        yaw = math.pi / 2 * float(rng.integers(4) if is_random else 2 * rng.integers(2))
        yaw += self.random_yaw(rng, 2 * self.turn_rad)
        mirror = 1.0 if rng.random() < 0.5 else -1.0
        extent_m = 2 * (HALF_LAYOUT_M * (abs(math.cos(yaw)) + abs(math.sin(yaw))))
        center = self.random_point(rng, extent_m)
        self.layout.place(center, yaw, mirror)
        new_box = self.layout.new_box
        for bodies, row in zip((self.tubes, self.swabs), self._rows(), strict=True):
            for column, body in zip(new_columns(self.rounds), bodies, strict=True):
                body.set_inactive(False)
                body_yaw = new_box.yaw_rad if is_random else 0.0
                body_yaw += math.pi / 2 + self.random_yaw(rng, 2 * self.skew_rad)
                if is_random:
                    body_yaw += math.pi * float(rng.integers(2))
                self.layout.lay(body, self.layout.to_world(new_box, (column, row)), body_yaw)

    def after_action(self) -> None:
        """Make the test of a presented tube and swab, or record a violation of the order."""
        tubes = [tube for tube in self.tubes if self._is_presented(tube)]
        swabs = [swab for swab in self.swabs if self._is_presented(swab)]
        if len(tubes) == len(swabs) == 1:
            if self._uncollected():
                self.has_failed = True
            else:
                self._make_test(tubes[0], swabs[0])
        elif max(len(tubes), len(swabs)) > 1:
            self.has_failed = True

    def evaluate(self) -> dict[str, bool]:
        """Return whether all tests are made and all tubes are in the box of used tubes."""
        return {
            "is_tested": len(self._used_swabs) == self.rounds,
            "is_collected": all(map(self.is_collected, self.tubes)),
        }

    def is_valid(self) -> bool:
        """Whether the order of the tests was kept and all objects are inside the workspace."""
        return not self.has_failed and super().is_valid()

    def is_collected(self, tube: Body) -> bool:
        """Whether a tube lies in the box of used tubes, released."""
        return tube is not self.robot.held_body() and self.layout.is_in_used_box(tube)

    @property
    def objects(self) -> Sequence[Body]:
        """The tubes and the unused swabs."""
        return [*self.tubes, *(swab for swab in self.swabs if swab not in self._used_swabs)]

    @property
    def landmarks(self) -> Sequence[YawPose]:
        """Poses of areas, tubes and swabs; the upper corner of the workspace for used swabs."""
        layout, corner = self.layout, (self.settings.workspace.upper_corner, 0.0)
        areas = (layout.new_box, layout.used_box, layout.test_area)
        return [
            corner if body in self._used_swabs else (body.position, body.yaw_rad)
            for body in (*areas, *self.tubes, *self.swabs)
        ]

    def get_state(self) -> CovidState:
        """Return the tests so far, and the seed of the following ones."""
        return CovidState(
            self._seed,
            tuple(self.tubes.index(tube) for tube in self._used_tubes),
            tuple(self.swabs.index(swab) for swab in self._used_swabs),
            self.has_failed,
        )

    def set_state(self, state: CovidState) -> None:
        """Restore the tests so far; the world restores which bodies are hidden."""
        self._seed, used_tubes, used_swabs, self.has_failed = state
        self._used_tubes = [self.tubes[i] for i in used_tubes]
        self._used_swabs = [self.swabs[i] for i in used_swabs]

    # -- heights of actions without z --------------------------------------------------------

    def pick_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        return max(top_m - self._tube_m[1] / 2, self.layout.floor_z_m(xy) + self._grasp_m)

    def place_height_m(self, top_m: float, xy: tuple[float, float]) -> float:
        return top_m + self._grasp_m + RELEASE_GAP_M

    def window_m(self, held: Body | None) -> float:
        """Return half the width of the window that is searched for the highest point, metres.

        With a held tube it contains the rim of a box, above which fingers and tube stay.
        """
        return RIM_WINDOW_M if held in self.tubes else WINDOW_M

    # -- tests -------------------------------------------------------------------------------

    def _make_test(self, tube: Body, swab: Body) -> None:
        """Remove the swab, and move the tube to a random pose in the test area."""
        deactivate_body(swab, self.swabs.index(swab))
        self._used_swabs.append(swab)
        self._used_tubes.append(tube)
        # seeded with the number of the test, so that the pose is independent of earlier actions
        rng = np.random.default_rng([self._seed, len(self._used_tubes)])
        others = [other for other in self.objects if other is not tube]
        for _ in range(TUBE_ATTEMPTS):
            xy = tuple(float(rng.uniform(-half, half)) for half in self.used_half_m)
            yaw = math.pi / 2 + self.random_yaw(rng, 2 * math.pi)
            self.layout.lay(tube, self.layout.to_world(self.layout.test_area, xy), yaw)
            if all(
                contacts.gap_m(self.world.client, other.id, tube.id) > GAP_M for other in others
            ):
                break
        self.world.settle(max_steps=REST_STEPS)

    def _uncollected(self) -> list[Body]:
        """Return the used tubes that are not in their box."""
        return [tube for tube in self._used_tubes if not self.is_collected(tube)]

    def _is_presented(self, body: Body) -> bool:
        """Whether a tube or unused swab lies in the test area, released."""
        if body in self._used_swabs or body is self.robot.held_body():
            return False
        return self.layout.is_above(self.layout.test_area, TEST_AREA.size, body)

    def _rows(self) -> tuple[float, float]:
        """Return y of the new tubes and of the new swabs in the frame of their box."""
        return new_rows(self._tube_m[0], self._swab_m[0])

    # -- expert ------------------------------------------------------------------------------

    def instruction(self) -> str:
        """Return the instruction with the number of tests and the colours of the areas."""
        return (
            f"lay a tube and a swab in the {colored(self.layout.test_area, 'area')}, then put the "
            f"tube into the {colored(self.layout.used_box, 'box')}, {counted(self.rounds, 'time')}"
        )

    def expert_command(self) -> PickPlaceCommand:
        """Collect a used tube, or present a tube or swab that is missing for the next test.

        Of several, it picks the one nearest to the test area that the fingers can grasp.
        """
        held = self.robot.held_body()
        if held is not None:
            return self._place(held)
        candidates = self._pick_candidates()
        if not candidates:
            return no_op(self.settings.workspace, is_holding=False)
        test_area = self.layout.test_area.position[:2]
        nearest = sorted(candidates, key=lambda body: math.dist(body.position[:2], test_area))
        body = next(filter(self._can_grasp, nearest), nearest[0])
        x, y, _ = body.position
        z = vertical_extent(body)[0] + self._grasp_m
        grasp = downward_pose((x, y, z), self._grasp_yaw(body))
        if not self._can_grasp(body):
            return perturbed_pick(self.world, body, grasp, self.action_limits)
        return pick_command(grasp)

    def _pick_candidates(self) -> list[Body]:
        """Return the bodies, one of which is picked next."""
        uncollected = self._uncollected()
        if uncollected:
            return uncollected
        if any(map(self._is_presented, self.tubes)):
            return [swab for swab in self.swabs if swab not in self._used_swabs]
        new = [tube for tube in self.tubes if tube not in self._used_tubes]
        # new tubes in the box of used tubes first, before others lie beside them
        return [tube for tube in new if self.is_collected(tube)] or new

    def _place(self, held: Body) -> PickPlaceCommand:
        """Return the place of the held body: collect it, present it, or return it to its box."""
        layout = self.layout
        if held in self._used_tubes:
            sites = USED_ROWS if self.action_limits.turn_rad else USED_COLUMNS
            return self._place_in(held, layout.used_box, sites, 0.0, rim_m=layout.used_rim_m)
        same_kind = self.tubes if held in self.tubes else self.swabs
        if self._uncollected() or any(map(self._is_presented, same_kind)):
            row = self._rows()[0 if same_kind is self.tubes else 1]
            sites = [(column, row) for column in new_columns(self.rounds)]
            return self._place_in(held, layout.new_box, sites, math.pi / 2)
        return self._place_in(held, layout.test_area, TEST_SITES, math.pi / 2)

    def _place_in(
        self,
        held: Body,
        area: Body,
        sites: Sequence[tuple[float, float]],
        yaw_rad: float,
        rim_m: float = -math.inf,
    ) -> PickPlaceCommand:
        """Return the place of the held body at the site of an area farthest from other objects.

        Args:
            sites: positions in the frame of the area.
            yaw_rad: yaw of the body in that frame, for a gripper that can turn.
            rim_m: least height of the fingertips.
        """
        tool = self.robot.tool_frame()
        others = [other.position for other in self.objects if other is not held]
        x, y = max(
            (self.layout.to_world(area, site) for site in sites),
            key=lambda site: min(math.dist(site, other[:2]) for other in others),
        )
        turn = -tool.yaw_rad
        if self.action_limits.turn_rad:
            turn = wrap_angle(area.yaw_rad + yaw_rad - held.yaw_rad, math.pi)
        z = self.layout.floor_z_m((x, y)) + RELEASE_GAP_M
        z = z + held.position[2] - vertical_extent(held)[0]
        command = place_command(tool, held.pose, held.pose.moved_to((x, y, z), turn))
        return command._replace(z_m=max(command.z_m, rim_m + self._grasp_m + RELEASE_GAP_M))

    def _can_grasp(self, body: Body) -> bool:
        """Whether a tube or swab lies flat and nothing is between it and the open fingers."""
        low, high = vertical_extent(body)
        bottom, top = body.shape.bounds_m
        if high - low > top[2] - bottom[2] + LEANING_M:
            return False
        gripper, (x, y, _) = self.robot.gripper, body.position
        others = [other for other in self.objects if other is not body]
        for other in (*others, *self.layout.walls):
            height_m = vertical_extent(other)[1] - (low + self._grasp_m)
            reach_m = gripper.finger_reach_below_m(height_m, self.finger_opening)
            hand = Rectangle(x, y, self._grasp_yaw(body), reach_m, gripper.half_width_m)
            if gap_m(hand, outline(other)) <= 0:
                return False
        return True

    @property
    def _grasp_m(self) -> float:
        """Height of the tool above the support of an object in a grasp."""
        return TIPS_GAP_M - self.robot.gripper.lowest_tip_m

    def _grasp_yaw(self, body: Body) -> float:
        return body.yaw_rad + math.pi / 2 if self.action_limits.turn_rad else 0.0
