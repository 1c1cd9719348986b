"""Robots that are not simulated while bodies settle."""

import pybullet
import pytest

import ba_torchrl
from ba_torchrl.sim.robots.base import ROBOTS, RobotSleep
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import Physics, World
from tests.specs import slow_except_two_robots

CUBE = Box(size_m=(0.05, 0.05, 0.05))


@pytest.fixture(params=[False, True], ids=["awake", "asleep"])
def sleeps(request):
    return request.param


def make_world(robot_name, *, sleeps, cubes=3):
    world = World(Physics(time_step_s=1 / 240, solver_iterations=30))
    robot = ROBOTS[robot_name](world)
    bodies = [world.add(CUBE, f"cube {i}") for i in range(cubes)]
    robot.teleport(robot.home_joints)
    robot.set_opening(1.0)
    if sleeps:
        world.sleepers.append(RobotSleep(robot, lambda: True))
    return world, robot, bodies


def link_poses(robot):
    links = range(pybullet.getNumJoints(robot.id, physicsClientId=robot.client))
    return [
        state[4:6]
        for state in pybullet.getLinkStates(
            robot.id, links, computeForwardKinematics=1, physicsClientId=robot.client
        )
    ]


def drop(bodies, position=(0.5, 0.0, 0.08)):
    """Place bodies in a leaning pile in the air."""
    x, y, z = position
    for i, body in enumerate(bodies):
        body.place((x + 0.012 * i, y + 0.008 * i, z + 0.055 * i), 0.3 * i)


@pytest.mark.parametrize("robot_name", slow_except_two_robots())
def test_bodies_settle_in_the_same_way_beside_a_sleeping_robot(robot_name):
    results = []
    for sleeps in (False, True):
        world, robot, bodies = make_world(robot_name, sleeps=sleeps)
        before = link_poses(robot)
        drop(bodies)
        assert world.settle()
        assert world.steps > 20
        results.append((world.steps, [body.pose for body in bodies]))
        for old, new in zip(before, link_poses(robot), strict=True):
            assert new[0] == pytest.approx(old[0], abs=1e-4)
        world.close()
    assert results[0] == results[1]  # bit for bit


def test_a_sleeping_robot_is_not_simulated_and_wakes_at_the_end():
    world, robot, bodies = make_world("kuka", sleeps=True)
    drop(bodies)
    speeds = []
    step = world.step

    def disturbed_step():
        # gravity alone would move the unpowered arm
        for joint in robot.arm_joints:
            pybullet.setJointMotorControl2(
                robot.id, joint, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=robot.client
            )
        before = robot.measured_joints()
        step()
        after = robot.measured_joints()
        speeds.append(max(abs(a - b) for a, b in zip(after, before, strict=True)))

    world.step = disturbed_step
    assert world.settle()
    del world.step
    assert speeds[0] > 1e-5  # the state takes effect after a step
    assert max(speeds[1:]) == 0.0
    world.step()
    assert robot.measured_joints() != pytest.approx(robot.home_joints, abs=1e-5)
    world.close()


def test_a_body_that_falls_on_a_sleeping_hand_stays_in_the_air(sleeps):
    world, robot, bodies = make_world("kuka", sleeps=sleeps, cubes=1)
    x, y, z = robot.tool_frame().position
    drop(bodies, (x, y, z + 0.4))
    world.settle()
    heights = [bodies[0].position[2]]
    for _ in range(3):
        assert pybullet.getContactPoints(robot.id, bodies[0].id, physicsClientId=world.client)
        world.step(5)
        heights.append(bodies[0].position[2])
    assert min(heights) > z
    world.close()


def test_contacts_of_a_robot_are_detected_after_it_slept(sleeps):
    world, robot, bodies = make_world("kuka", sleeps=sleeps)
    drop(bodies)
    assert world.settle()
    x, y, _ = bodies[0].position
    joints = robot.inverse_kinematics((x - 0.15, y, -0.01), ((1, 0, 0), (0, -1, 0), (0, 0, -1)))
    robot.teleport(joints)
    world.detect_collisions()
    assert pybullet.getContactPoints(robot.id, world.floor, physicsClientId=world.client)
    world.close()


@pytest.mark.parametrize("max_steps", [1, 5, 200])
def test_a_robot_is_simulated_in_the_first_step_after_it_slept(sleeps, max_steps):
    world, robot, bodies = make_world("kuka", sleeps=sleeps)
    drop(bodies)
    assert world.settle(max_steps) is (max_steps == 200)
    before = robot.measured_joints()
    robot.command([q + 0.01 for q in robot.home_joints])
    world.step()
    moved = [after - q for after, q in zip(robot.measured_joints(), before, strict=True)]
    assert max(map(abs, moved)) > 1e-3
    world.close()


def test_a_robot_that_moves_holds_or_touches_something_does_not_sleep():
    world, robot, bodies = make_world("kuka", sleeps=False)
    holds = False
    sleep = RobotSleep(robot, lambda: not holds)
    drop(bodies)
    world.settle()
    assert sleep.is_possible()
    holds = True
    assert not sleep.is_possible()
    holds = False
    robot.command([q + 0.01 for q in robot.home_joints])
    assert not sleep.is_possible()  # it is not yet there
    world.step(60)
    assert sleep.is_possible()
    joint = robot.arm_joints[0]
    pybullet.resetJointState(
        robot.id, joint, robot.joints[0], targetVelocity=0.1, physicsClientId=robot.client
    )
    assert not sleep.is_possible()
    robot.teleport(robot.home_joints)
    assert sleep.is_possible()
    robot.command_opening(0.5)
    assert not sleep.is_possible()
    world.step(60)
    assert sleep.is_possible()
    bodies[0].place(robot.tool_frame().position)
    world.detect_collisions()
    assert not sleep.is_possible()
    world.close()


def interrupt():
    raise KeyboardInterrupt


def interrupt_settle(world, after_step):
    """Raise an exception after a physics step of `World.settle`."""
    step = world.step

    def interrupted_step():
        step()
        if world.steps == after_step:
            interrupt()

    world.step = interrupted_step
    with pytest.raises(KeyboardInterrupt):
        world.settle()
    del world.step


def test_an_interrupted_settle_leaves_the_robot_awake():
    world, robot, bodies = make_world("kuka", sleeps=True)
    drop(bodies)
    interrupt_settle(world, after_step=10)
    robot.command([q + 0.01 for q in robot.home_joints])
    world.step(60)
    assert robot.measured_joints() == pytest.approx(robot.joints, abs=1e-3)
    world.close()


def test_a_state_restored_after_an_interrupted_settle_continues_as_before_it():
    played = []
    for interrupts in (0, 1, 2):
        world, robot, bodies = make_world("kuka", sleeps=True)
        world.seal()
        if interrupts:
            drop(bodies)
            (sleeper,) = world.sleepers
            if interrupts == 2:  # the second one as the robot is woken
                sleeper.set_asleep = lambda is_asleep, sleeper=sleeper: (
                    RobotSleep.set_asleep(sleeper, True) if is_asleep else interrupt()
                )
            interrupt_settle(world, after_step=10)
            vars(sleeper).pop("set_asleep", None)
        world.restore_pristine()
        robot.command([q + 0.01 for q in robot.home_joints])
        world.step()
        played.append(robot.measured_joints())
        world.close()
    assert played[0] == played[1] == played[2]


@pytest.mark.parametrize("fast_mode", [True, False])
def test_an_open_loop_robot_sleeps_only_if_it_is_teleported(fast_mode):
    env = ba_torchrl.make("open_loop/block_stacking", obs_size=32, seed=0, fast_mode=fast_mode)
    env.reset()
    assert bool(env.scene.world.sleepers) is fast_mode
    assert all(sleeper.is_possible() for sleeper in env.scene.world.sleepers)
    env.close()
