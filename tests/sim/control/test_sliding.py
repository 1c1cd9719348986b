"""Close-loop motions in contact: the tool slides along surfaces within its force limits."""

import pytest

from ba_torchrl.sim.contacts import lateral_force_n, outer_contacts, vertical_force_n
from ba_torchrl.sim.control.close_loop import CloseLoopController
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World


class Scene:
    """An arm whose fingers press on the floor."""

    def __init__(self, robot, opening, *shapes):
        self.world = World()
        self.robot = ROBOTS[robot](self.world)
        self.bodies = [self.world.add(shape, f"body {i}") for i, shape in enumerate(shapes)]
        self.world.seal()
        self.controller = CloseLoopController(self.robot)
        self.controller.reset(((0.45, -0.1, 0.1), 0.0))
        self.controller.grip(opening)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.world.close()

    @property
    def tool(self):
        return self.robot.tool_pose()[0]

    def move(self, x, y, z):
        self.controller.move_to((x, y, z), 0.0)

    def forces(self):
        points = outer_contacts(self.world.client, self.robot.id)
        return vertical_force_n(points), lateral_force_n(points)


@pytest.mark.parametrize("opening", [0.0, 1.0])
@pytest.mark.parametrize("robot", list(ROBOTS))
def test_fingers_that_press_on_the_floor_slide_along_it(robot, opening):
    with Scene(robot, opening) as scene:
        for _ in range(2):
            scene.move(0.45, -0.1, -0.02)  # the floor stops the fingers
        height_m = scene.tool[2]
        for y in (-0.05, 0.0, 0.05):
            scene.move(0.45, y, -0.02)
            assert scene.tool == pytest.approx((0.45, y, height_m), abs=4e-3)
            assert scene.forces()[0] < 2 * scene.controller.limits.max_vertical_force_n


@pytest.mark.parametrize("robot", list(ROBOTS))
def test_a_wall_stops_fingers_that_slide_along_the_floor(robot):
    with Scene(robot, 0.0, Box(size_m=(0.3, 0.02, 0.1), mass_kg=0.0)) as scene:
        scene.bodies[0].place((0.45, 0.0, 0.05), 0.0)
        for _ in range(4):
            scene.move(0.45, scene.tool[1] + 0.05, -0.02)
        assert -0.06 < scene.tool[1] < 0.0
        assert scene.tool[2] < 0.03


def test_fingers_climb_a_slope_that_they_are_pushed_against():
    with Scene("kuka", 0.0, Box(size_m=(0.2, 0.2, 0.02), mass_kg=0.0)) as scene:
        ramp = scene.bodies[0]
        ramp.set_pose((0.45, 0.05, 0.0), (0.2164396, 0.0, 0.0, 0.976296))  # 25 degrees about x
        for _ in range(2):
            scene.move(0.45, -0.1, -0.02)
        height_m = scene.tool[2]
        for _ in range(5):
            scene.move(0.45, scene.tool[1] + 0.04, -0.02)
        assert scene.tool[1] > 0.05
        slope_m = 0.466 * (scene.tool[1] - 0.05) + 0.011  # of the upper face
        assert scene.tool[2] == pytest.approx(height_m + slope_m, abs=0.01)
