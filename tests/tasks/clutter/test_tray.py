"""The tray: profile, friction of base and walls, and closed corners."""

import math

import numpy as np
import pytest

from ba_torchrl.sim.shapes import Box, Decal
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.terrain.tray import FLOOR_Z_M, RIM_Z_M, Tray
from ba_torchrl.tasks.workspace import Workspace

CENTER = (0.45, 0.02)
WORKSPACE = Workspace((0.3, 0.6), (-0.13, 0.17), (0.01, 0.25))


@pytest.fixture
def world():
    with World() as world:
        Tray(world, WORKSPACE)
        yield world


def height(heights, x, y, side=0.5, pixels=500):
    i = int((x - (CENTER[0] - side / 2)) / side * pixels)
    j = int((y - (CENTER[1] - side / 2)) / side * pixels)
    return heights[i, j]


def test_objects_are_placed_on_the_base():
    with World() as world:
        tray = Tray(world, WORKSPACE)
        block = world.add(Box(size_m=(0.03, 0.03, 0.03)), "block")
        assert tray.height_m(CENTER) == FLOOR_Z_M == 0.002
        tray.stand(block, CENTER, 0.4)
        assert block.position == pytest.approx((*CENTER, 0.017))
        assert tray.gap_below_m(block) == pytest.approx(0.0, abs=1e-9)
        (base,) = tray.support_ids
        assert world.settle()
        assert base in {body.id for body in world.bodies if body.touches(block)}


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_the_height_image_shows_the_profile(world, direction):
    heights = HeightCamera(world.bodies).heightmap(CENTER, 0.5, 500)

    def at(distance):
        return height(heights, *(c + distance * d for c, d in zip(CENTER, direction, strict=True)))

    assert at(0.0) == pytest.approx(FLOOR_Z_M)
    assert at(0.12) == pytest.approx(FLOOR_Z_M)
    lip = 0.125 + 0.0075
    assert at(lip) == pytest.approx(FLOOR_Z_M + 0.0075 * math.tan(math.radians(20)), abs=5e-4)
    wall = (at(0.2) - at(0.16)) / 0.04
    assert wall == pytest.approx(1.0, abs=0.03)  # 45 degrees
    assert heights.max() == pytest.approx(RIM_Z_M, abs=2e-3)


def test_corners_are_closed(world):
    heights = HeightCamera(world.bodies).heightmap(CENTER, 0.46, 460)
    inside = heights[5:-5, 5:-5]
    assert inside.min() >= FLOOR_Z_M - 1e-9
    diagonal = np.diagonal(heights)[: len(heights) // 2]
    assert np.all(np.diff(diagonal[8:]) <= 1e-9)  # decreases from rim to base without a gap


def test_the_tray_hides_a_goal_area_below_it(world):
    goal = world.add(Decal(size_m=(0.09, 0.09, 1e-3), recess_depth_m=0.02), "goal")
    block = world.add(Box(size_m=(0.03, 0.03, 0.03)), "block")
    camera = HeightCamera(world.bodies)
    for y in (-0.05, 0.05):  # the second image is drawn over that of the static bodies
        goal.place((*CENTER, 0.0))
        block.place((CENTER[0], y, 0.017))
        heights = camera.heightmap(CENTER, 0.5, 500)
        assert height(heights, *CENTER) == pytest.approx(FLOOR_Z_M)
        assert heights.min() >= 0.0


def test_blocks_slide_off_the_walls_and_stay_on_the_base(world):
    block = Box(size_m=(0.03, 0.03, 0.03), friction=0.6)
    on_wall, on_floor = world.add(block, "on the wall"), world.add(block, "on the floor")
    on_wall.place((CENTER[0] + 0.19, CENTER[1], 0.1))
    on_floor.place((CENTER[0] - 0.05, CENTER[1] - 0.05, FLOOR_Z_M + 0.015))
    world.settle(600)
    assert on_wall.position[0] < CENTER[0] + 0.15
    assert math.dist(on_floor.position, (CENTER[0] - 0.05, CENTER[1] - 0.05, 0.017)) < 2e-3


def test_dropped_blocks_stay_in_the_tray(world):
    blocks = [world.add(Box(size_m=(0.02, 0.04, 0.02)), f"block {i}") for i in range(8)]
    rng = np.random.default_rng(0)
    for block in blocks:
        x, y = (c + rng.uniform(-0.1, 0.1) for c in CENTER)
        block.set_pose((x, y, 0.4), (0.3, 0.1, 0.0, 0.9487))
        world.step(30)
    world.settle(600)
    for block in blocks:
        assert 0.008 < block.position[2] < 0.08
        assert max(abs(p - c) for p, c in zip(block.position, CENTER, strict=False)) < 0.16
