"""Close-loop motions with a held body, which is teleported with the arm where nothing is near."""

import math

import numpy as np
import pybullet
import pytest

from ba_torchrl.sim.control.close_loop import CloseLoopController, pose_in_tool_frame, slip
from ba_torchrl.sim.geometry import Pose
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import FINE_PHYSICS, World
from tests.specs import slow_except_two_robots

SIZE_M = 0.04
HEIGHT_M = 0.2


class Scene:
    """A cube under the open gripper, and other boxes."""

    def __init__(
        self,
        robot="kuka",
        *,
        teleport=True,
        physics=None,
        size_m=(SIZE_M,) * 3,
        friction=1.0,
        mass_kg=0.1,
        boxes=(),
    ):
        self.world = World(physics)
        self.robot = ROBOTS[robot](self.world)
        cube = Box(size_m=size_m, mass_kg=mass_kg, friction=friction)
        self.cube = self.world.add(cube, "cube")
        self.others = [self.world.add(shape, "box") for shape, _ in boxes]
        self.world.seal()
        for body, (_, position) in zip(self.others, boxes, strict=True):
            body.place(position)
        self.cube.place((0.45, -0.1, SIZE_M / 2))
        self.controller = CloseLoopController(self.robot, teleport=teleport)
        self.controller.reset(((0.45, -0.1, 0.15), 0.0))
        self.controller.move_to((0.45, -0.1, 0.015), 0.0)
        self.controller.grip(0.0)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.world.close()

    def move(self, x, y, z, yaw_rad=0.0):
        """Return the number of physics steps."""
        before = self.world.steps
        self.controller.move_to((x, y, z), yaw_rad)
        return self.world.steps - before

    def lift(self):
        return self.move(0.45, -0.1, HEIGHT_M)

    @property
    def grasp(self):
        return pose_in_tool_frame(self.robot, self.cube)


@pytest.mark.parametrize("robot", slow_except_two_robots())
def test_a_body_that_does_not_slip_keeps_its_pose_in_the_tool_frame(robot):
    with Scene(robot) as scene:
        assert scene.lift() > 10
        first, steps, rng = scene.grasp, [], np.random.default_rng(0)
        for _ in range(30):
            before, (tool, yaw_rad) = scene.grasp, scene.robot.tool_pose()
            target = rng.uniform((0.4, -0.1, 0.1), (0.55, 0.1, 0.22))
            position = [t + np.clip(g - t, -0.05, 0.05) for t, g in zip(tool, target, strict=True)]
            steps.append(scene.move(*position, yaw_rad + rng.uniform(-0.4, 0.4)))
            assert scene.robot.held_body() is scene.cube
            assert scene.robot.tool_pose()[0] == pytest.approx(position, abs=1e-3)
            slip_m, turn_rad = slip(before, scene.grasp)
            assert slip_m < 2e-4
            assert turn_rad < 0.01
        assert steps.count(1) > 20
        assert max(steps) < 4
        slip_m, turn_rad = slip(first, scene.grasp)
        assert slip_m < 5e-4
        assert turn_rad < 0.03


def test_slip():
    half = 0.05
    turned = Pose((0.3, 0.0, 0.004), (math.sin(half), 0.0, 0.0, math.cos(half)))
    assert slip(Pose((0.1, 0.003, 0.0)), turned) == pytest.approx((0.005, 0.1))
    negated = turned._replace(orientation=tuple(-q for q in turned.orientation))
    assert slip(turned, negated) == pytest.approx((0.0, 0.0), abs=1e-7)


def test_every_grasp_is_simulated_in_its_first_motion():
    with Scene() as scene:
        scene.lift()
        assert scene.move(0.45, 0.0, 0.0145) > 1  # the cube is put down
        scene.controller.grip(1.0)
        scene.controller.grip(0.0)
        assert scene.robot.held_body() is scene.cube
        assert scene.lift() > 10
        assert scene.move(0.45, 0.0, HEIGHT_M) == 1


def test_without_teleports_every_motion_is_simulated_and_ends_alike():
    poses = []
    for teleport in (True, False):
        with Scene(teleport=teleport) as scene:
            scene.lift()
            steps = scene.move(0.5, 0.05, HEIGHT_M, 0.5) + scene.move(0.45, 0.05, 0.1, 0.2)
            assert (steps == 2) is teleport
            scene.move(0.45, 0.05, 0.017, 0.2)
            scene.controller.grip(1.0)
            scene.world.settle()
            poses.append(scene.cube.pose)
    assert math.dist(poses[0].position, poses[1].position) < 1e-3
    assert poses[0].yaw_rad == pytest.approx(poses[1].yaw_rad, abs=0.02)


@pytest.mark.parametrize(
    ("robot", "physics", "friction", "mass_kg"),
    [
        ("kuka", None, 0.21, 0.6),
        ("kuka", FINE_PHYSICS, 0.05, 0.3),
        ("panda", FINE_PHYSICS, 0.06, 0.6),
        ("ur5", None, 0.18, 0.6),
    ],
)
def test_a_body_that_friction_cannot_hold_stays_on_the_floor(robot, physics, friction, mass_kg):
    with Scene(robot, physics=physics, friction=friction, mass_kg=mass_kg) as scene:
        assert scene.robot.held_body() is scene.cube
        scene.move(0.45, -0.1, 0.015)  # supported by the floor, the body does not slip
        for z in (0.065, 0.115, 0.165):
            scene.move(0.45, -0.1, z)
            assert scene.cube.position[2] < 0.03


@pytest.mark.parametrize(("physics", "friction"), [(None, 0.15), (FINE_PHYSICS, 0.0)])
def test_a_teleported_body_falls_when_friction_does_not_hold_it_any_more(physics, friction):
    with Scene(physics=physics, mass_kg=0.6) as scene:
        scene.lift()
        assert scene.move(0.45, 0.0, HEIGHT_M) == 1
        pybullet.changeDynamics(
            scene.cube.id, -1, lateralFriction=friction, physicsClientId=scene.world.client
        )
        for i in range(6):
            scene.move(0.45, 0.02 * (i % 2), HEIGHT_M)
        assert scene.robot.held_body() is not scene.cube
        scene.world.settle()
        assert scene.cube.position[2] < 0.05


def test_targets_of_the_fingers_below_the_width_of_the_body_keep_the_grasp():
    with Scene() as scene:
        scene.lift()
        for opening in (0.02, 0.1, 0.0):
            scene.controller.grip(opening)
            assert scene.move(0.45, opening, HEIGHT_M) == 1
        scene.controller.grip(1.0)
        scene.world.settle()
        assert scene.cube.position[2] == pytest.approx(SIZE_M / 2, abs=1e-3)


def test_a_reset_forgets_the_grasp():
    with Scene() as scene:
        scene.lift()
        scene.controller.reset(((0.45, -0.1, HEIGHT_M), 0.0), opening=0.0)
        assert scene.controller.get_state() == (0.0, None, None)


def test_the_end_of_a_held_bar_does_not_pass_through_a_wall():
    wall = (Box(size_m=(0.3, 0.02, 0.3), mass_kg=0.0), (0.45, 0.13, 0.15))
    with Scene(size_m=(SIZE_M, 0.16, SIZE_M), boxes=[wall]) as scene:
        scene.lift()
        assert scene.move(0.45, 0.0, HEIGHT_M) == 1
        for _ in range(3):
            assert scene.move(0.45, 0.1, HEIGHT_M) > 1
            assert scene.cube.position[1] + 0.08 < 0.13
        assert not scene.controller.is_out_of_reach


def test_a_body_on_top_of_the_held_one_is_carried_and_never_left_in_the_air():
    top = (Box(size_m=(0.03,) * 3, mass_kg=0.1), (0.45, -0.02, 0.055))
    for z in (HEIGHT_M - 0.05, HEIGHT_M - 0.1):
        with Scene(size_m=(SIZE_M, 0.2, SIZE_M), mass_kg=0.2, boxes=[top]) as scene:
            for height in (0.05, 0.1, 0.15, HEIGHT_M):
                scene.move(0.45, -0.1, height)
            scene.world.step(60)
            body = scene.others[0]
            gap_m = body.position[2] - scene.cube.position[2]
            assert scene.move(0.45, -0.1, z) > 3
            assert body.position[2] - scene.cube.position[2] < gap_m + 2e-3


def test_no_body_is_teleported_while_another_one_moves():
    ball = (Box(size_m=(0.03,) * 3, mass_kg=0.1), (0.6, 0.2, 0.015))
    with Scene(boxes=[ball]) as scene:
        scene.lift()
        scene.others[0].place((0.6, 0.2, 0.3))  # it falls
        scene.world.step(5)
        assert scene.move(0.45, -0.05, HEIGHT_M) > 3
        scene.world.settle()
        assert scene.move(0.45, 0.0, HEIGHT_M) == 1


def test_a_held_body_pushes_another_as_without_teleports():
    block = (Box(size_m=(0.05, 0.05, 0.05), mass_kg=0.1), (0.45, 0.05, 0.025))
    ends = []
    for teleport in (True, False):
        with Scene(boxes=[block], teleport=teleport) as scene:
            scene.lift()
            scene.move(0.45, -0.1, 0.03)
            for y in (-0.05, 0.0, 0.05, 0.1):
                scene.move(0.45, y, 0.03)
            assert scene.robot.held_body() is scene.cube
            assert scene.cube.position[1] == pytest.approx(0.1, abs=1e-3)
            ends.append(scene.others[0].position)
    assert ends[0][1] > 0.14
    assert ends[0] == pytest.approx(ends[1], abs=5e-3)


def test_the_state_contains_whether_the_body_is_firmly_held():
    with Scene() as scene:
        scene.lift()
        state, world, robot = (
            scene.controller.get_state(),
            scene.world.snapshot(),
            scene.robot.get_state(),
        )
        scene.controller.grip(1.0)
        ends = []
        for _ in range(2):
            scene.world.restore(world)
            scene.robot.set_state(robot)
            scene.controller.set_state(state)
            assert scene.move(0.5, 0.0, HEIGHT_M, 0.3) == 1
            ends.append(scene.cube.pose)
        assert ends[0] == ends[1]
