"""Drawer Opening: geometry of the cabinet, conditions of success, contacts, expert."""

import math
from functools import partial

import numpy as np
import pybullet
import pytest
import torch

import ba_torchrl
from ba_torchrl.envs.episodes import evaluate_at_rest
from ba_torchrl.sim.shapes import Box, Solid
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.close_loop.drawer_opening import cabinet_parts
from tests.tasks.episodes import play

TASK = "close_loop/drawer_opening"
FIXED = {"random_orientation": False, "action_sequence": "pxyz"}


@pytest.fixture
def make(make_started):
    return partial(make_started, TASK)


def local_heights(travel, pose, center, side, pixels):
    """Return the heights computed from the sizes, and which pixels are too close to an edge."""
    (x, y), yaw = pose
    steps = (np.arange(pixels) + 0.5) * side / pixels - side / 2
    px, py = np.meshgrid(center[0] + steps - x, center[1] + steps - y, indexing="ij")
    u, v = px * math.cos(yaw) + py * math.sin(yaw), py * math.cos(yaw) - px * math.sin(yaw)
    image, unsure = np.zeros_like(u), np.zeros_like(u, dtype=bool)

    def rectangle(u_range, v_range, height):
        gaps = np.minimum.reduce([u - u_range[0], u_range[1] - u, v - v_range[0], v_range[1] - v])
        image[gaps > 0] = np.maximum(image, np.broadcast_to(height, u.shape))[gaps > 0]
        unsure[abs(gaps) < 1e-4] = True

    d = u - travel
    out = (travel - 0.097, travel + 0.1)
    rectangle(out, (-0.102, 0.102), 0.019)  # the drawer's floor
    rectangle(out, (0.096, 0.102), 0.085)  # its sides, back and front
    rectangle(out, (-0.102, -0.096), 0.085)
    rectangle((out[0], out[0] + 0.006), (-0.102, 0.102), 0.085)
    rectangle((travel + 0.1, travel + 0.11), (-0.102, 0.102), 0.097)
    rectangle((travel + 0.11, travel + 0.16), (0.035, 0.043), 0.084)  # posts
    rectangle((travel + 0.11, travel + 0.16), (-0.043, -0.035), 0.084)
    arc = np.sqrt(np.clip(0.0075**2 - (d - 0.16) ** 2, 0, None))
    rectangle((travel + 0.1525, travel + 0.1675), (-0.05, 0.05), 0.08 + arc)  # rod
    rectangle((-0.11, 0.11), (-0.115, 0.115), 0.11)  # the cabinet covers the drawer
    return image, unsure


@pytest.mark.parametrize("travel", [0.0, 0.1, 0.2])
def test_the_height_image_shows_cabinet_drawer_and_handle_in_their_sizes(make, travel):
    env = make()
    scene = env.scene
    scene.task.cabinet.place((0.42, 0.03, 0.0), 0.7, travel)
    image = scene.camera.heightmap((0.48, 0.05), 0.6, 200)
    expected, unsure = local_heights(travel, ((0.42, 0.03), 0.7), (0.48, 0.05), 0.6, 200)
    assert unsure.mean() < 0.02
    np.testing.assert_allclose(image[~unsure], expected[~unsure], atol=2.5e-3)
    flat = ~unsure & ~((expected > 0.08) & (expected < 0.0876))  # the rod is a polygon
    np.testing.assert_allclose(image[flat], expected[flat], atol=1e-6)


@pytest.mark.parametrize(
    ("x", "y", "height"), [(0.18, 0.03, 0.019), (0.0, 0.0, 0.11)], ids=["its floor", "the cabinet"]
)
def test_the_drawer_is_hollow_and_open_on_top(make, x, y, height):
    with World() as world:
        cabinet = make().scene.task.cabinet
        shapes = [part.shape for part in cabinet.parts]
        cabinet = world.add_articulated(*shapes, cabinet.joint, "cabinet")
        dropped = world.add(Box(size_m=(0.03, 0.03, 0.03)), "block")
        cabinet.place((0.0, 0.0, 0.0), travel_m=0.2)
        dropped.place((x, y, 0.14))
        world.step(120)
        assert dropped.position[2] == pytest.approx(height + 0.015, abs=2e-3)


def test_the_cabinet_is_hollow_in_front_and_between_its_walls():
    with World() as world:
        cabinet = world.add(Solid(parts=cabinet_parts(), mass_kg=0.0), "cabinet")
        cabinet.place((0.0, 0.0, 0.0))
        world.detect_collisions()

        def first_hit(start, end):
            (hit,) = pybullet.rayTestBatch([start], [end], physicsClientId=world.client)
            return None if hit[0] != cabinet.id else hit[3]

        assert first_hit((0.3, 0.0, 0.055), (-0.3, 0.0, 0.055))[0] == pytest.approx(-0.1, abs=1e-3)
        for start, end, axis, expected in (
            ((0, 0, 0.055), (0, 0.3, 0.055), 1, 0.105),
            ((0, 0, 0.055), (0, -0.3, 0.055), 1, -0.105),
            ((0, 0, 0.055), (0, 0, 0.3), 2, 0.1),
            ((0, 0, 0.055), (0, 0, -0.05), 2, 0.01),
        ):
            assert first_hit(start, end)[axis] == pytest.approx(expected, abs=1e-3)


def test_layouts_open_towards_the_centre_with_the_handle_in_the_workspace(make):
    for config in ({}, FIXED):
        env = make(**config)
        task, yaws = env.scene.task, []
        rng = np.random.default_rng(0)
        for _ in range(300):
            task.initialize_episode(rng)
            (x, y, z), yaw = task.cabinet.base.position, task.cabinet.base.yaw_rad
            ux, uy = math.cos(yaw), math.sin(yaw)
            back = (0.45 - x) * ux + (0.0 - y) * uy
            aside = (0.45 - x) * -uy + (0.0 - y) * ux
            assert 0.15 <= back <= 0.2
            assert abs(aside) <= 0.1
            assert z == 0
            (hx, hy, _), _ = task.handle_pose
            for s in (-0.02, 0.15):
                assert task.settings.workspace.contains((hx + s * ux, hy + s * uy, 0.08))
            yaws.append(yaw)
        if config:
            assert {round(abs(yaw), 3) for yaw in yaws} == {round(math.pi / 2, 3)}
            assert 100 < sum(yaw > 0 for yaw in yaws) < 200
        else:
            assert (np.histogram(yaws, 6, (-math.pi, math.pi))[0] > 25).all()


def test_a_workspace_too_small_for_the_handle_is_refused():
    with pytest.raises(ba_torchrl.core.errors.ConfigError, match="handle"):
        ba_torchrl.make(TASK, workspace=((0.4, 0.5), (-0.05, 0.05), (0.01, 0.25)))


def test_success_requires_fifteen_centimetres_of_travel(make):
    env = make()
    task, cabinet = env.scene.task, env.scene.task.cabinet
    assert not task.is_success()
    pose = (cabinet.base.position, cabinet.base.yaw_rad)
    for travel, expected in ((0.149, False), (0.151, True)):
        cabinet.place(*pose, travel)
        env.scene.world.settle()
        assert task.is_success() is expected


def test_a_drawer_that_moves_back_is_not_a_success(make):
    """Success is evaluated at rest."""
    env = make()
    cabinet = env.scene.task.cabinet
    cabinet.place(cabinet.base.position, cabinet.base.yaw_rad, 0.152)
    pybullet.resetJointState(cabinet.id, 0, 0.152, -0.5, physicsClientId=env.scene.world.client)
    assert env.scene.task.is_success()
    conditions, valid = evaluate_at_rest(env.scene)
    assert valid
    assert conditions == {"is_open": False}
    assert cabinet.travel_m < 0.15


def at_handle(env, ahead, height, opening, turn, across=0.0):
    """Place cabinet and gripper: the rod along y at x = 0.41, the drawer opens towards -x."""
    scene = env.scene
    scene.task.cabinet.place((0.57, 0.0, 0.0), math.pi)
    scene.controller.reset(((0.41 - ahead, across, height), turn), opening)
    return scene


def move(scene, dx=0.0, dy=0.0, dz=0.0, turn=0.0):
    (x, y, z), yaw = scene.robot.tool_pose()
    scene.controller.move_to((x + dx, y + dy, z + dz), yaw + turn)


def follow(scene, commands):
    """Follow the expert's commands within 5 cm and 45 degrees each."""
    for _ in range(commands):
        command = scene.task.expert_command()
        share = min(1.0, 0.05 / max(abs(d) for d in command[1:4])) if any(command[1:4]) else 1.0
        dx, dy, dz = (share * d for d in command[1:4])
        turn = max(-math.pi / 4, min(math.pi / 4, command.dyaw_rad))
        move(scene, dx, dy, dz, turn)


@pytest.mark.parametrize(
    ("ahead", "across", "height", "turn", "expected"),
    [
        (-0.0255, 0.0, 0.14, 0.0, True),
        (-0.034, 0.009, 0.14, 0.0, True),  # with a free way, at an angle
        (-0.0255, 0.0, 0.14, 0.5, True),  # the fingers turn on the way
        (-0.0255, 0.0, 0.14, 0.9, False),  # by more than one action can
        (0.01, 0.0, 0.14, 0.0, False),  # above and ahead of the rod
        (-0.005, 0.0, 0.20, 0.0, True),
        (-0.07, 0.0, 0.14, 0.0, False),  # the cabinet's edge is on the way
        (-0.0255, 0.03, 0.12, 0.0, False),  # and a post
        (-0.038, 0.0, 0.09, 0.0, True),  # between rod and front
        (-0.038, 0.0, 0.09, 0.5, False),  # it turns first
        (-0.016, 0.0, 0.085, 0.0, True),  # hooked by less than a centimetre: it pulls and lowers
    ],
)
def test_the_expert_descends_where_its_fingers_have_a_free_way(
    make, ahead, across, height, turn, expected
):
    scene = at_handle(make(), ahead, height, 0.0, math.pi / 2 + turn, across)
    assert (height + scene.task.expert_command().dz_m < 0.08) == expected  # below the rod's axis
    follow(scene, 3 if expected else 6)
    (rx, ry, rz), _ = scene.task.handle_pose
    (x, y, z), _ = scene.robot.tool_pose()
    assert z < rz  # hooked, or pulling
    assert 0.0 < x - rx < 0.05
    assert abs(y - ry) < 0.015


def test_the_expert_succeeds_from_states_of_random_actions_and_turns(make):
    env, rng, lengths = make(expert=True), np.random.default_rng(0), []
    for _ in range(15):
        state = env.reset()
        while not state["done"]:
            action = state["expert_action"].clone()
            if rng.random() < 0.1:
                action = torch.from_numpy(rng.uniform(-1, 1, 5).astype(np.float32))
            if rng.random() < 0.5:
                action[4] = float(rng.uniform(-1, 1))
            state = env.step(state.set("action", action))["next"]
        lengths.append(int(state["step_count"]))
    assert np.mean(lengths) < 17  # 24, if the gripper does not turn on its way


def test_a_pulled_drawer_follows_the_fingers_and_stays(make):
    scene = at_handle(make(), -0.026, 0.07, 0.0, math.pi / 2)
    travels = []
    for _ in range(6):
        move(scene, dx=-0.05)
        travels.append(scene.task.cabinet.travel_m)
    # a gap of 8.5 mm first, then 5 cm each, up to the limit of the joint
    np.testing.assert_allclose(travels, [0.0415, 0.0915, 0.1415, 0.1915, 0.2, 0.2], atol=4e-3)
    scene.world.settle()
    assert scene.task.cabinet.travel_m == pytest.approx(0.2, abs=2e-3)
    for _ in range(6):
        move(scene, dx=0.05)
    scene.world.settle()
    assert scene.task.cabinet.travel_m == pytest.approx(0.0, abs=2e-3)


def test_fingers_closed_on_the_rod_pull_it_without_a_held_body(make):
    scene = at_handle(make(), 0.0, 0.08, 0.2, 0.0)
    scene.controller.grip(0.0)
    assert scene.robot.held_body() is None
    for _ in range(3):
        move(scene, dx=-0.05)
    assert scene.task.cabinet.travel_m == pytest.approx(0.15, abs=3e-3)


def test_the_motion_stops_at_a_handle_that_cannot_move(make):
    scene = at_handle(make(), 0.0, 0.14, 0.0, math.pi / 2)
    for _ in range(3):  # onto the rod from above
        move(scene, dz=-0.05)
    assert scene.robot.tool_pose()[0][2] > 0.08
    assert scene.task.handle_pose[0][2] == pytest.approx(0.08, abs=1e-6)
    scene = at_handle(make(), -0.026, 0.07, 0.0, math.pi / 2)
    for _ in range(3):  # along the rod, into a post
        move(scene, dy=0.05)
    assert scene.robot.tool_pose()[0][1] < 0.035
    np.testing.assert_allclose(scene.task.cabinet.base.position, (0.57, 0.0, 0.0), atol=1e-9)


def test_random_actions_keep_the_drawer_within_its_joint_limits(make):
    env = make()
    rng = np.random.default_rng(0)
    for episode in range(6):
        state = env.reset()
        scene = env.scene
        handle, heading = scene.task.handle_pose  # start at the handle
        scene.controller.reset(((*handle[:2], 0.15), heading))
        while not state["done"]:
            action = rng.choice([-1.0, 1.0], 5) if episode % 2 else rng.uniform(-1, 1, 5)
            state = env.step(state.set("action", torch.tensor(action, dtype=torch.float32)))
            state = state["next"]
            assert -5e-3 < scene.task.cabinet.travel_m < 0.205
    assert env.faults == 0


def test_scaled_drawers_open_by_scaled_travel(make):
    env = make(object_scale_range=0.9, expert=True)
    assert env.scene.task.cabinet.joint.limits_m == (0.0, pytest.approx(0.18))
    np.testing.assert_allclose(env.scene.task.handle_pose[0][2], 0.072, atol=1e-6)
    assert play(env, env.reset())["success"]
    assert 0.135 < env.scene.task.cabinet.travel_m < 0.17


def test_the_vector_lists_gripper_cabinet_and_handle(make):
    env = make(obs_type="vec")
    vector = env.reset()["observation"].numpy()
    assert vector.shape == (1 + 4 * 3,)
    (x, y, z), yaw = env.scene.task.handle_pose
    expected = ((x - 0.45) / 0.15, y / 0.15, (z - 0.13) / 0.12, yaw / math.pi)
    np.testing.assert_allclose(vector[-4:], expected, atol=1e-5)


@pytest.mark.parametrize("scale", [0.85, 1.0, 1.4])
def test_the_collision_surface_is_that_of_the_image(make, scale):
    """Rays hit floor, front and handle of the drawer, and the cabinet, at the rendered heights."""
    scene = make(object_scale_range=scale).scene
    scene.task.cabinet.place((0.45, 0.0, 0.0), 0.0, travel_m=0.15 * scale)
    side, pixels = 0.9, 900
    heights = scene.camera.heightmap((0.45, 0.0), side, pixels)
    points = {
        "cabinet": (0.02, 0.05),
        "floor": (0.2, 0.0),
        "rim": (0.2, 0.099),
        "front": (0.255, 0.0),
        "post": (0.28, 0.039),
        "rod": (0.31, 0.0),
    }
    for part, point in points.items():
        x, y = 0.45 + point[0] * scale, point[1] * scale
        (hit,) = pybullet.rayTest((x, y, 0.25), (x, y, -0.1), physicsClientId=scene.world.client)
        row, column = (int((c - m + side / 2) / side * pixels) for c, m in ((x, 0.45), (y, 0.0)))
        assert hit[3][2] == pytest.approx(heights[row, column], abs=4e-4), part
