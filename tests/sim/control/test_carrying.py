"""Close-loop motions with a held body, which is teleported with the arm where nothing is near."""

import math

import numpy as np
import pytest

from ba_torchrl.sim.control.close_loop import CloseLoopController
from ba_torchrl.sim.control.held_body import pose_in_tool_frame, slip
from ba_torchrl.sim.geometry import Pose
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World

SIZE_M = 0.04
HEIGHT_M = 0.2


class Scene:
    """A cube under the open gripper, and other boxes."""

    def __init__(self, robot="kuka", *, teleport=True, friction=1.0, mass_kg=0.1, boxes=()):
        self.world = World()
        self.robot = ROBOTS[robot](self.world)
        cube = Box(size_m=(SIZE_M,) * 3, mass_kg=mass_kg, friction=friction)
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


@pytest.mark.parametrize("robot", list(ROBOTS))
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


@pytest.mark.parametrize("friction", [0.06, 0.1])
def test_a_body_that_slips_is_not_teleported(friction):
    with Scene(friction=friction, mass_kg=0.6) as scene:
        scene.lift()
        heights_m = [scene.cube.position[2]]
        for i in range(6):
            if scene.robot.held_body() is not scene.cube:
                break
            assert scene.move(0.45, -0.1 + 0.01 * (i % 2), HEIGHT_M) > 3
            heights_m.append(scene.cube.position[2])
        assert heights_m[-1] < 0.1 or heights_m[-1] < heights_m[0] - 5e-3


def test_a_held_body_does_not_pass_through_a_wall():
    wall = (Box(size_m=(0.3, 0.02, 0.3), mass_kg=0.0), (0.45, 0.0, 0.15))
    with Scene(boxes=[wall]) as scene:
        scene.lift()
        for _ in range(3):
            assert scene.move(0.45, 0.1, HEIGHT_M) > 1
            assert scene.cube.position[1] < -SIZE_M / 2
        assert not scene.controller.is_out_of_reach


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
