"""`BulletArmEnv.render`: the workspace fills the image and shows the arm and the held object."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pybullet
import pytest
import torch

from ba_torchrl.core import keys
from ba_torchrl.envs import base
from ba_torchrl.envs.rendering import ARM_VIEW, scene_viewpoint
from ba_torchrl.record.video import FrameRecorder
from ba_torchrl.sim.geometry import downward
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.rgb import FOV_DEG, _render, render_rgb
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.workspace import Workspace
from tests.specs import slow_except, slow_except_two_robots
from tests.tasks.episodes import follow_expert

STACKING = "open_loop/block_stacking"
SETTINGS = {"seed": 1, "expert": True, "obs_size": 32}
SLOW = pytest.mark.slow


@pytest.fixture
def make(make):
    return lambda task=STACKING, **settings: make(task, **settings)


def viewpoint_of(env, aspect=4 / 3):
    terrain = env.scene.task.terrain
    return scene_viewpoint(env.scene.world, terrain, env.hand_point.above(terrain), aspect)


def red_pixels(image):
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return (red > 2 * green) & (red > 2 * blue)


def workspace_share(env, size=100):
    """Return the share of `render`'s pixels whose rays meet the ground in the workspace."""
    (x0, x1), (y0, y1) = env.workspace.x, env.workspace.y
    view = np.reshape(viewpoint_of(env).view_matrix(), (4, 4)).T
    projection = np.reshape(pybullet.computeProjectionMatrixFOV(FOV_DEG, 4 / 3, 0.05, 10), (4, 4)).T
    to_world = np.linalg.inv(projection @ view)
    col, row = np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size))
    near, far = (
        np.stack([col, row, np.full_like(col, depth), np.ones_like(col)], -1) @ to_world.T
        for depth in (-1, 1)
    )
    near, far = near[..., :3] / near[..., 3:], far[..., :3] / far[..., 3:]
    fraction = near[..., 2:] / (near[..., 2:] - far[..., 2:])
    x, y = np.moveaxis((near + fraction * (far - near))[..., :2], -1, 0)
    return ((x > x0) & (x < x1) & (y > y0) & (y < y1)).mean()


@pytest.mark.parametrize(
    ("task", "least"),
    [(STACKING, 0.3), ("open_loop/covid_test", 0.3), ("close_loop/block_picking", 0.2)],
)
def test_the_workspace_fills_the_image(make, task, least):
    env = make(task)
    env.reset()
    assert workspace_share(env) > least


@pytest.mark.parametrize("task", ["open_loop/bottle_arrangement", "close_loop/drawer_opening"])
def test_all_images_of_an_episode_have_the_same_camera_pose(make, task):
    env = make(task)
    state = env.reset()
    before = viewpoint_of(env)
    while not state[keys.DONE]:
        state = follow_expert(env, state)
        np.testing.assert_allclose(np.hstack(viewpoint_of(env)), np.hstack(before), atol=1e-6)


def test_bodies_of_the_terrain_are_shown_in_the_workspace_only():
    workspace = Workspace(x=(0.25, 0.65), y=(-0.2, 0.2), z=(0.0, 0.4))
    with World() as world:
        table = world.add(Box(size_m=(2.0, 2.0, 0.01), mass_kg=0.0), "table")
        table.place((0.45, 0.0, 0.005))
        pallet = world.add(Box(size_m=(0.1, 0.1, 0.01), mass_kg=0.0), "pallet")
        pallet.place((5.0, 5.0, 0.005))  # outside of the workspace
        ground, object_on_it = (
            scene_viewpoint(
                world, SimpleNamespace(workspace=workspace, support_ids=ids), (0.45, 0, 0.2), 1.0
            )
            for ids in ({table.id}, set())
        )
    assert ground.distance_m < 1.2
    assert object_on_it.distance_m > 3 * ground.distance_m
    assert object_on_it.distance_m < 10


@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5"])
def test_open_loop_images_show_the_arm_above_the_workspace(make, robot):
    env = make(robot=robot)
    env.reset()
    at_home = render_rgb(env.scene.world, viewpoint_of(env)).astype(int)
    differs = (np.abs(env.render().astype(int) - at_home) > 60).any(-1)
    hand = differs[:120]  # in the upper third
    assert hand.sum() > 1000
    rows, _ = np.nonzero(hand)
    assert rows.max() > 60  # it reaches into the image


def test_the_held_object_is_in_the_gripper(make):
    env = make()
    state = env.reset()
    before = red_pixels(env.render())
    assert not before[:100].any()
    state = follow_expert(env, state)
    assert state[keys.HOLDING]
    assert env.scene.controller.held.is_hidden
    after = red_pixels(env.render())
    assert after[:150].sum() > 200  # all cubes on the ground are below
    env.scene.controller.held = None
    assert red_pixels(env.render())[:150].sum() == 0


def test_images_of_a_grasp_and_a_release_show_the_hand_at_the_object(make):
    env = make()
    seen = []

    def record():
        tool = env.scene.robot.tool_frame().position
        nearest = min(math.dist(tool, body.position) for body in env.scene.task.objects)
        seen.append((nearest, red_pixels(env.render())))

    env.on_contact = record
    state, actions = env.reset(), 0
    while not state[keys.DONE]:
        state = follow_expert(env, state)
        actions += 1
        assert len(seen) == actions
    assert state[keys.SUCCESS]
    assert max(distance for distance, _ in seen) < 0.03
    assert all(red.sum() > 200 for _, red in seen)


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        ("open_loop/house_building_1", {}),
        (STACKING, {"robot": "ur5_robotiq", "num_objects": 2}),
        ("bump/house_building_4", {"max_steps": 2}),
        pytest.param("open_loop/house_building_1", {"fast_mode": False}, marks=SLOW),
        pytest.param(STACKING, {"robot": "panda", "num_objects": 2}, marks=SLOW),
        pytest.param(STACKING, {"robot": "ur5", "num_objects": 2}, marks=SLOW),
        pytest.param("ramp/house_building_2", {}, marks=SLOW),
    ],
)
def test_videos_and_images_change_no_step(make, task, settings):
    results = []
    for motion in (None, False, True):
        env = make(task, **settings)
        recorder = FrameRecorder(env, 32, 24, motion=motion)
        if motion is None:
            env.on_contact = None
        state, seen = env.reset(), []
        while not state[keys.DONE]:
            if motion is not None:
                recorder.record()
            state = follow_expert(env, state)
            entries = {key: value.clone() for key, value in state.items()}
            world = env.scene.world
            physics = [
                (
                    pybullet.getBasePositionAndOrientation(body, physicsClientId=world.client),
                    pybullet.getBaseVelocity(body, physicsClientId=world.client),
                    pybullet.getJointStates(
                        body,
                        range(pybullet.getNumJoints(body, physicsClientId=world.client)),
                        physicsClientId=world.client,
                    ),
                )
                for body in range(pybullet.getNumBodies(physicsClientId=world.client))
            ]
            seen.append((entries, physics))
        results.append(seen)
    assert len(results[0]) >= 2
    for seen in results[1:]:
        for (entries, physics), (others, other_physics) in zip(results[0], seen, strict=True):
            assert entries.keys() == others.keys()
            assert all(torch.equal(value, others[key]) for key, value in entries.items())
            assert physics == other_physics


class Motion:
    """Poses of the arm in the frames of a video of an expert's episode, which are not drawn."""

    def __init__(self, monkeypatch, env):
        self.tools, self.held, self.links, self.viewpoints = [], [], [], []
        self.env = env
        monkeypatch.setattr(base, "render_rgb", self._draw)
        self.recorder = FrameRecorder(env, 40, 40, motion=True)
        state = env.reset()
        self.recorder.record()
        while not state[keys.DONE]:
            state = follow_expert(env, state)
            self.recorder.record()
        self.contacts = self.recorder.contacts

    def _draw(self, world, viewpoint, width, height, **_):
        display = self.env._display
        is_display = world is display._scene.world
        scene = display._scene if is_display else self.env.scene
        tool = scene.robot.tool_frame()
        self.tools.append(tool.position)
        held = display._held[0] if is_display and display._held is not None else None
        self.held.append(None if held is None else math.dist(held.position, tool.position))
        view = np.reshape(viewpoint.view_matrix(), (4, 4)).T
        projection = pybullet.computeProjectionMatrixFOV(FOV_DEG, width / height, 0.05, 10)
        links = np.pad(scene.robot.link_positions(), ((0, 0), (0, 1)), constant_values=1.0)
        image = links @ (np.reshape(projection, (4, 4)).T @ view).T
        self.links.append(image[:, :2] / image[:, 3:])
        self.viewpoints.append(np.hstack(viewpoint))
        return np.zeros((height, width, 3), np.uint8)


FILMED = ["open_loop/house_building_3", "ramp/house_building_2", "bump/house_building_4"]


@pytest.mark.parametrize(
    ("task", "robot"),
    slow_except(
        [*itertools.product(FILMED, ROBOTS)],
        [(FILMED[0], "kuka"), (FILMED[1], "ur5_robotiq")],
    ),
)
def test_the_arm_of_a_video_moves_between_poses_and_is_in_every_frame(
    make, monkeypatch, task, robot
):
    motion = Motion(monkeypatch, make(task, robot=robot))
    steps = [math.dist(*pair) for pair in itertools.pairwise(motion.tools)]
    assert max(steps) < 0.14  # also where one joint moves further than the tool
    assert len(motion.contacts) >= 2
    for contact, after in itertools.pairwise([*motion.contacts, len(steps)]):
        between = steps[contact:after]
        assert len(between) > 2
        assert sum(between) > 0.1
    held = [distance for distance in motion.held if distance is not None]
    assert len(held) > 8
    assert max(held) < 0.05
    assert np.abs(motion.links).max() < 0.9  # the sides of the image are at 1
    assert np.ptp(motion.viewpoints, axis=0).max() < 1e-6


@pytest.mark.parametrize("robot", slow_except_two_robots())
@pytest.mark.parametrize("size_m", [0.4, pytest.param(0.3, marks=SLOW)])
def test_the_whole_arm_is_in_the_image_at_every_corner_of_the_workspace(make, robot, size_m):
    half = size_m / 2
    env = make(robot=robot, workspace=((0.45 - half, 0.45 + half), (-half, half), (0.0, 0.4)))
    env.reset()
    (image,) = env.video_images(120, 120)
    assert image.shape == (120, 120, 3)
    display = env._display
    seen = []
    for x, y, z in itertools.product(env.workspace.x, env.workspace.y, (0.01, 0.15, 0.25)):
        joints = display._scene.robot.inverse_kinematics((x, y, z), downward(0.0))
        if joints is None:
            continue
        display._move(joints)
        viewpoint = scene_viewpoint(
            display._scene.world, env.scene.task.terrain, display.extent_m(), 1.0, ARM_VIEW
        )
        view = viewpoint.view_matrix()
        projection = pybullet.computeProjectionMatrixFOV(FOV_DEG, 1.0, 0.05, 10)
        _, _, owner = _render(display._scene.world, 120, 120, view, projection)
        is_arm = owner == display._scene.robot.id
        seen.append(is_arm.sum())
        assert not is_arm[[0, -1]].any()
        assert not is_arm[:, [0, -1]].any()
    assert len(seen) >= 8
    assert min(seen) > 400


def test_a_video_in_close_loop_is_its_images(make):
    env = make("close_loop/block_reaching")
    recorder = FrameRecorder(env, 80, 80, motion=True)
    state = env.reset()
    recorder.record()
    np.testing.assert_array_equal(recorder.frames, [env.render(80, 80)])
    follow_expert(env, state)
    recorder.record()
    assert len(recorder.frames) == 2


def test_the_arm_keeps_its_pose_if_the_other_one_is_out_of_reach(make):
    env = make()
    env.reset()
    world = env._display.posed(env.scene, 0.6, (3.0, 0.0, 0.2), downward(0.0))
    joints = env._display._scene.robot.measured_joints()
    assert joints == env.scene.robot.measured_joints()
    for body, copy in zip(env.scene.world.bodies, world.bodies, strict=True):
        np.testing.assert_allclose(np.hstack(body.pose), np.hstack(copy.pose), atol=1e-12)


def test_closing_closes_the_second_world(make):
    env = make()
    env.reset()
    env.render(32, 24)
    world = env._display._scene.world
    env.close()
    assert world.is_closed
