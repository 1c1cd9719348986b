"""Grasp and push planner on scenes whose best grasp is computed by hand, for several grippers."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from ba_torchrl.sim.geometry import Pose
from ba_torchrl.sim.robots.base import ROBOTS, measured_gripper
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.sim.shapes import Box
from ba_torchrl.tasks.clutter import grasp_planner
from ba_torchrl.tasks.clutter.grasp_planner import CLEARANCE_M, DEEPEST_M, PIXEL_M, GraspPlanner
from ba_torchrl.tasks.clutter.push_planner import PushPlanner
from ba_torchrl.tasks.manipulation.top_down_grasps import TopDownGrasp
from ba_torchrl.tasks.workspace import ActionLimits, Workspace

WORKSPACE = Workspace((0.3, 0.6), (-0.15, 0.15), (0.01, 0.25))
REACH = ActionLimits(0.05, math.pi / 4)
TOOL = ((0.45, 0.0, 0.2), 0.0)
FLOOR_M = 2e-3

TRAY = SimpleNamespace(height_m=lambda xy: FLOOR_M, half_m=0.125)

JAW = Gripper(
    half_gap_m=0.04,
    half_width_m=0.01,
    closed_half_m=0.016,
    palm_height_m=0.07,
    tip_arc=((0.0, -0.01), (0.04, -0.01)),
    outline=(
        *((u, 0.07) for u in np.arange(0.0, 0.04, 0.005).tolist()),
        *((u, -0.01) for u in (0.04, 0.045, 0.05, 0.055)),
    ),
    closed_outline=(*((u, -0.01) for u in (0.0, 0.005, 0.01, 0.015)), (0.05, 0.07), (0.09, 0.07)),
)
"""Fingers that slide, with tips 1 cm below the tool."""
SWING = replace(
    JAW,
    tip_arc=((0.0, -0.01), (0.04, 0.006)),
    outline=(*JAW.outline[:-4], *((u, 0.006) for u in (0.04, 0.045, 0.05, 0.055))),
)
"""Fingers whose tips are above the tool when open and descend on an arc as they close."""


@dataclass
class Lying:
    """The attributes of a body that the planner reads."""

    shape: Box
    position: tuple[float, float, float]
    yaw_rad: float = 0.0

    @property
    def pose(self):
        half = self.yaw_rad / 2
        return Pose(self.position, (0.0, 0.0, math.sin(half), math.cos(half)))


def block(size_m, xy=(0.45, 0.0), yaw_rad=0.0):
    return Lying(Box(size_m=size_m), (*xy, FLOOR_M + size_m[2] / 2), yaw_rad)


def scene(gripper, *bodies):
    """Return a planner and the height image of upright boxes on a flat floor."""
    planner = GraspPlanner(bodies, None, WORKSPACE, gripper)
    heights = np.full_like(planner._empty_image, FLOOR_M)
    i, j = np.indices(heights.shape)
    x = planner.corner[0] + (i + 0.5) * PIXEL_M
    y = planner.corner[1] + (j + 0.5) * PIXEL_M
    for body in bodies:
        dx, dy = x - body.position[0], y - body.position[1]
        cos, sin = math.cos(body.yaw_rad), math.sin(body.yaw_rad)
        inside = (abs(cos * dx + sin * dy) <= body.shape.size_m[0] / 2) & (
            abs(cos * dy - sin * dx) <= body.shape.size_m[1] / 2
        )
        heights[inside] = FLOOR_M + body.shape.size_m[2]
    return planner, heights


def plan(gripper, target, *others):
    planner, heights = scene(gripper, target, *others)
    return planner.plan([target], TOOL, REACH, heights)


def test_a_slab_is_grasped_across_at_its_centre():
    for yaw in (0.0, 0.7, 1.3, 1.9):
        target = block((0.03, 0.11, 0.03), yaw_rad=yaw)
        grasp = plan(JAW, target)
        assert grasp.body is target
        # closing fingers rotate the body by the remaining angle
        assert abs(math.cos(grasp.yaw_rad - yaw)) > 0.7
        assert math.dist(grasp.position[:2], target.position[:2]) < 0.01


@pytest.mark.parametrize("gripper", [JAW, SWING], ids=["slides", "swings"])
@pytest.mark.parametrize("palm_height_m", [0.02, 0.03, 0.07])
def test_a_tall_block_is_grasped_as_deep_as_the_palm_allows(gripper, palm_height_m):
    inner = [(u, min(z, palm_height_m)) for u, z in gripper.outline]
    gripper = replace(gripper, palm_height_m=palm_height_m, outline=tuple(inner))
    target = block((0.03, 0.03, 0.1))
    top = FLOOR_M + 0.1
    grasp = plan(gripper, target)
    # at half a gap of 15 mm
    deepest = DEEPEST_M + gripper.tip_height_m(0.015)
    assert grasp.position[2] == pytest.approx(
        top - min(palm_height_m - CLEARANCE_M, deepest), abs=1e-3
    )


def test_open_fingers_stay_above_neighbours():
    target = block((0.03, 0.11, 0.06))
    beside = [block((0.03, 0.2, 0.03), (0.45 + x, 0.0)) for x in (-0.06, 0.06)]
    assert plan(JAW, target).position[2] < 0.03
    grasp = plan(JAW, target, *beside)
    # height of the neighbours, length of the fingers below the tool, and the gap
    assert grasp.position[2] >= FLOOR_M + 0.03 + 0.01 + CLEARANCE_M - 1e-6


def test_fingers_that_close_on_an_arc_stay_above_neighbours():
    """Open fingers at a lower height have clearance, but touch the neighbours as they close."""
    target = block((0.03, 0.11, 0.06))
    beside = [block((0.03, 0.2, 0.03), (0.45 + x, 0.0)) for x in (-0.065, 0.065)]
    grasp = plan(SWING, target, *beside)
    # a finger of 16 mm above the neighbours' inner edge, at 50 mm, is at half a gap of 34 mm
    tip = SWING.tip_height_m(0.034)
    assert tip < 0.006
    assert grasp.position[2] >= FLOOR_M + 0.03 - tip + CLEARANCE_M - 1e-3


@pytest.mark.parametrize("half_gap_m", [0.025, 0.04])
def test_bodies_wider_than_the_gap_have_no_grasp(half_gap_m):
    gripper = replace(
        JAW,
        half_gap_m=half_gap_m,
        tip_arc=((0.0, -0.01), (half_gap_m, -0.01)),
    )
    for width, fits in ((2 * half_gap_m - 0.01, True), (2 * half_gap_m + 0.004, False)):
        assert (plan(gripper, block((width, width, 0.03))) is not None) is fits


def test_fingers_with_high_tips_have_no_grasp_of_a_flat_body():
    flat = block((0.07, 0.07, 0.012))
    assert plan(JAW, flat) is not None
    high = replace(SWING, tip_arc=((0.0, 0.0), (0.04, 0.006)))
    assert plan(high, flat) is None


def test_the_risk_of_a_body_alone_depends_on_the_yaw():
    target = block((0.03, 0.11, 0.03))
    planner, _ = scene(JAW, target)
    samples = planner.placed_samples(target)
    across = planner.risk_alone(samples, (TOOL[0], 0.0))
    along = planner.risk_alone(samples, (TOOL[0], math.pi / 2))
    assert across < 0.5
    assert along == grasp_planner.WORST_RISK


@pytest.mark.parametrize("name", list(ROBOTS))
def test_a_push_starts_above_the_floor_and_behind_the_body(name):
    gripper = measured_gripper(ROBOTS[name])
    target = block((0.03, 0.03, 0.03), (0.4, 0.0))
    planner, heights = scene(gripper, target)
    push = PushPlanner(planner, TRAY).plan([target], TOOL, REACH, heights)
    tips = push.start[2] + gripper.tip_height_m(0.0)
    assert FLOOR_M + 2e-3 < tips < FLOOR_M + 0.01
    assert math.dist(push.start[:2], target.position[:2]) > 0.015 + gripper.closed_half_m


def test_a_push_without_contact_of_hand_and_wall_is_preferred():
    target, wall_x = block((0.03, 0.03, 0.03), (0.45, 0.05)), 0.5325
    wall = block((0.2, 0.4, 0.09), (wall_x + 0.1, 0.0))
    gaps = []
    for height in (0.09, 0.03):  # of the part of the hand that is 18 cm wide, above the tool
        gripper = replace(JAW, closed_outline=(*JAW.closed_outline[:-1], (0.09, height)))
        planner, heights = scene(gripper, target, wall)
        push = PushPlanner(planner, TRAY).plan([target], TOOL, REACH, heights)
        gaps.append(wall_x - 0.09 - max(push.start[0], push.end[0]))
    over_the_wall, beside_it = gaps
    assert over_the_wall < 0
    assert beside_it > 0


def test_the_way_to_a_grasp_passes_over_what_is_below_it():
    """A wall of 0.1 m crosses the way; the tips are 1 cm below the tool."""
    planner = GraspPlanner([], SimpleNamespace(), WORKSPACE, JAW)
    heights = planner._empty_image.copy()
    start, goal = (0.35, 0.0, 0.2), (0.55, 0.0, 0.02)
    grasp = TopDownGrasp(None, goal, 0.0)
    free = planner.height_on_way((start, 0.0), grasp, REACH, heights, CLEARANCE_M)
    assert free == pytest.approx(goal[2])
    near, far = (int((x - planner.corner[0]) / PIXEL_M) for x in (0.49, 0.51))
    heights[near:far] = 0.1
    # the tips, up to 5.5 cm ahead of the tool, reach the wall at x = 0.435, in the second action
    passing_z = 0.1 + 0.01 + CLEARANCE_M
    found = planner.height_on_way((start, 0.0), grasp, REACH, heights, CLEARANCE_M)
    assert passing_z - REACH.step_m <= found <= passing_z
    low = planner.height_on_way(((*start[:2], 0.02), 0.0), grasp, REACH, heights, 0.0)
    assert low == pytest.approx(found - CLEARANCE_M)
    # linear in the first action: above the wall when the tips reach it
    beside = (0.425, 0.0, 0.06)
    found = planner.height_on_way((beside, 0.0), grasp, REACH, heights, 0.0)
    assert found > 0.11
