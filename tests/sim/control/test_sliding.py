"""Close-loop motions in contact: the tool slides along surfaces within its force limits."""

import math

import pytest

from ba_torchrl.sim.contacts import (
    Contact,
    lateral_direction,
    lateral_force_n,
    outer_contacts,
    vertical_direction,
    vertical_force_n,
)
from ba_torchrl.sim.control.close_loop import CloseLoopController, Path
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from tests.specs import slow_except_two_robots


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
@pytest.mark.parametrize("robot", slow_except_two_robots())
def test_fingers_that_press_on_the_floor_slide_along_it(robot, opening):
    with Scene(robot, opening) as scene:
        for _ in range(2):
            scene.move(0.45, -0.1, -0.02)  # the floor stops the fingers
        height_m = scene.tool[2]
        for y in (-0.05, 0.0, 0.05):
            scene.move(0.45, y, -0.02)
            assert scene.tool == pytest.approx((0.45, y, height_m), abs=4e-3)
            assert scene.forces()[0] < 2 * scene.controller.limits.max_vertical_force_n


@pytest.mark.parametrize("robot", slow_except_two_robots())
def test_a_wall_stops_fingers_that_slide_along_the_floor(robot):
    with Scene(robot, 0.0, Box(size_m=(0.3, 0.02, 0.1), mass_kg=0.0)) as scene:
        scene.bodies[0].place((0.45, 0.0, 0.05), 0.0)
        for _ in range(4):
            scene.move(0.45, scene.tool[1] + 0.05, -0.02)
        assert -0.06 < scene.tool[1] < 0.0
        assert scene.tool[2] < 0.03


@pytest.mark.parametrize("heading", [-0.5, 0.5])
def test_fingers_that_are_pushed_against_a_wall_slide_along_it(heading):
    with Scene("kuka", 0.0, Box(size_m=(0.4, 0.02, 0.2), mass_kg=0.0)) as scene:
        wall = scene.bodies[0]
        wall.place((0.45, 0.0, 0.1), heading)
        for _ in range(4):
            scene.move(scene.tool[0], scene.tool[1] + 0.05, 0.1)
            assert scene.forces()[1] < 2 * scene.controller.limits.max_lateral_force_n
        along_m = (scene.tool[0] - 0.45) * math.cos(heading) + scene.tool[1] * math.sin(heading)
        across_m = scene.tool[1] * math.cos(heading) - (scene.tool[0] - 0.45) * math.sin(heading)
        assert math.copysign(along_m, heading * along_m) > 0.04
        assert -0.06 < across_m < -0.01  # on the same side


def test_the_direction_of_lateral_forces_is_their_weighted_mean():
    def contact(normal, force_n):
        return Contact(0, 1, 2, 0, 0, *[(0.0, 0.0, 0.0)] * 2, normal, 0.0, force_n, *[0.0] * 4)

    points = [contact((1.0, 0.0, 0.0), 30.0), contact((0.0, 1.0, 0.0), 40.0)]
    vertical = contact((0.0, 0.0, 1.0), 500.0)
    assert lateral_direction([*points, vertical]) == pytest.approx((0.6, 0.8))
    opposed = [contact((1.0, 0.0, 0.0), 30.0), contact((-1.0, 0.0, 0.0), 30.0)]
    assert lateral_direction(opposed) == (0.0, 0.0)
    assert lateral_direction([vertical]) == (0.0, 0.0)
    assert vertical_direction([*points, vertical]) == 1.0
    assert (
        vertical_direction([contact((0.0, 0.0, -1.0), 500.0), vertical._replace(force_n=1.0)]) == -1
    )


@pytest.mark.parametrize(
    ("direction", "end"),
    [
        ((0.0, 0.0, 1.0), (0.47, 0.02, 0.221)),  # a force from below does not stop a rise
        ((0.0, 0.0, -1.0), (0.47, 0.02, 0.199)),
        ((-1.0, 0.0, 0.0), (0.449, 0.02, 0.22)),
        ((0.0, 1.0, 0.0), (0.47, 0.021, 0.22)),
        ((-0.6, -0.8, 0.0), (0.4526, -0.0032, 0.22)),
    ],
)
def test_a_path_yields_by_a_distance_and_loses_its_motion_against_it(direction, end):
    class Robot:
        joints = None

        def tool_pose(self):
            return (0.45, 0.0, 0.2), 0.0

        def inverse_kinematics(self, position, *_):
            return position

    path = Path(Robot(), ((0.43, -0.02, 0.18), 0.0), ((0.47, 0.02, 0.22), 0.0))
    path.yield_to(direction, 0.5, 1e-3)
    assert path.joints_at(1.0) == pytest.approx(end, abs=1e-9)
    tool = path.joints_at(0.5)
    moved = tuple(0.001 * d for d in direction)
    assert tool == pytest.approx((0.45 + moved[0], moved[1], 0.2 + moved[2]), abs=1e-9)
    assert path.remaining_m(0.5) == pytest.approx(math.dist(tool, end), abs=1e-9)


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
