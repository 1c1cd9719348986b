"""`ManipulationEnv.render`: the workspace fills the image and shows the arm and the held object."""

import math
from types import SimpleNamespace

import numpy as np
import pybullet
import pytest
import torch

import ba_torchrl
from ba_torchrl.envs import keys
from ba_torchrl.envs.rendering import scene_viewpoint
from ba_torchrl.sim.geometry import downward
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.rgb import FOV_DEG, render_rgb
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.workspace import Workspace

STACKING = "open_loop/block_stacking"


@pytest.fixture
def make():
    made = []

    def build(task=STACKING, **settings):
        env = ba_torchrl.make(task, **{"seed": 1, "expert": True, "obs_size": 32, **settings})
        made.append(env)
        return env

    yield build
    for env in made:
        env.close()


def follow_expert(env, state):
    return env.step(state.set(keys.ACTION, state[keys.EXPERT_ACTION]))[keys.NEXT]


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


@pytest.mark.parametrize("fast_mode", [True, False])
def test_rendering_changes_no_observation_and_no_pose(make, fast_mode):
    results = []
    for render in (False, True):
        env = make("open_loop/house_building_1", fast_mode=fast_mode)
        if render:
            env.on_contact = lambda env=env: env.render(32, 24)
        state, seen = env.reset(), []
        while not state[keys.DONE]:
            if render:
                env.render(32, 24)
            state = follow_expert(env, state)
            poses = [body.pose for body in env.scene.world.bodies]
            seen.append((state[keys.PIXELS], state[keys.IN_HAND], poses))
        results.append(seen)
    plain, rendered = results
    assert len(plain) == len(rendered)
    for (a, b, poses), (c, d, others) in zip(plain, rendered, strict=True):
        assert torch.equal(a, c)
        assert torch.equal(b, d)
        assert poses == others


def test_objects_of_every_scale_are_drawn_at_their_size(make):
    env = make(object_scale_range=(0.6, 0.9))
    seen = {}
    for _ in range(6):
        env.reset()
        seen[env.scene.task.settings.scale] = red_pixels(env.render()).sum()
    scales = sorted(seen)
    assert seen[scales[-1]] > 1.1 * seen[scales[0]]


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
