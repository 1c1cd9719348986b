"""Block in Bowl: shape of the bowl, conditions of success, expert."""

import math

import numpy as np
import pybullet
import pytest

from ba_torchrl.sim.geometry import PlanarFrame
from ba_torchrl.sim.meshes import (
    bowl_parts,
    box_mesh,
    centroid,
    prism_mesh,
    ring_parts,
    transform_mesh,
)
from ba_torchrl.sim.shapes import Box, Solid
from ba_torchrl.sim.world import World
from tests.tasks.episodes import follow

TASK = "close_loop/block_in_bowl"
FLOOR_M = 0.016
BOWL = {"foot_radius_m": 0.045, "floor_m": FLOOR_M, "wall_m": 0.006}


@pytest.fixture
def env(make_started):
    return make_started(TASK, obs_size=64, expert=True)


def volume(mesh):
    corners = mesh.vertices[mesh.faces]
    return np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6


def test_parts_of_the_bowl_are_convex_closed_and_face_outwards():
    for part in bowl_parts(0.08, 0.07, **BOWL):
        center = part.vertices.mean(axis=0)
        for a, b, c in part.vertices[part.faces]:
            normal = np.cross(b - a, c - a)
            assert normal @ (a - center) > 0
            assert ((part.vertices - a) @ normal).max() < 1e-12
        edges = {(i, j) for face in part.faces for i, j in zip(face, np.roll(face, -1))}  # noqa: B905
        assert edges == {(j, i) for i, j in edges}


def test_volumes_and_centroids_match_formulas():
    # a regular polygon with 64 sides is a circle to 0.2 %
    angles = np.arange(64) * math.pi / 32
    disc = prism_mesh([(0.1 * math.cos(a), 0.1 * math.sin(a)) for a in angles], 0.2, 0.5)
    assert volume(disc) == pytest.approx(math.pi * 0.01 * 0.3, rel=2e-3)
    ring = ring_parts([(0.1, 0.0), (0.2, 0.0), (0.2, 0.3), (0.1, 0.3)], 64)
    assert sum(map(volume, ring)) == pytest.approx(math.pi * 0.03 * 0.3, rel=2e-3)
    boxes = [
        transform_mesh(box_mesh((1, 1, 1)), (0, 0, 0.5)),
        transform_mesh(box_mesh((1, 1, 3)), (2, 0, 1.5)),
    ]
    np.testing.assert_allclose(centroid(boxes), (1.5, 0.0, 1.25), atol=1e-12)


def test_the_bowl_has_its_size_and_stands_upright(env):
    low, high = env.scene.task.bowl.shape.bounds_m
    np.testing.assert_allclose(np.subtract(high, low), (0.16, 0.16, 0.07), atol=1e-9)
    bowl = env.scene.task.bowl
    assert bowl.position[2] == pytest.approx(0.035, abs=5e-4)
    assert bowl.tilt_rad < 5e-3
    mass = pybullet.getDynamicsInfo(bowl.id, -1, physicsClientId=bowl.client)[0]
    assert mass == 0.1


def test_the_bowl_is_hollow_for_collisions():
    with World() as world:
        parts = tuple(bowl_parts(0.08, 0.07, **BOWL))
        bowl = world.add(Solid(parts=parts, center_of_mass_m=centroid(parts)), "bowl")
        cube = world.add(Box(size_m=(0.02, 0.02, 0.02), mass_kg=0.02), "cube")
        for x, height in ((0.0, FLOOR_M), (0.03, FLOOR_M)):
            bowl.place((0.5, 0.0, 0.035))
            cube.place((0.5 + x, 0.0, 0.08))
            assert world.settle()
            assert cube.position[2] == pytest.approx(height + 0.01, abs=1e-3)
            assert cube.touches(bowl)
            assert bowl.tilt_rad < 0.01


def test_the_height_image_shows_the_cavity(env):
    task, camera = env.scene.task, env.scene.camera
    task.block.place((0.55, 0.12, 0.025))
    task.bowl.place((0.4, 0.0, 0.035))
    image = camera.heightmap((0.4, 0.0), 0.2, 100)
    assert image[50, 50] == pytest.approx(FLOOR_M, abs=1e-4)
    assert image.max() == pytest.approx(0.07, abs=1e-4)
    assert image[50, 50 + 42] == 0  # 8.4 cm from the axis


def test_initial_poses_keep_their_distances(env):
    task, rng = env.scene.task, np.random.default_rng(0)
    for _ in range(200):
        task.initialize_episode(rng)
        (x, y, _), (bowl_x, bowl_y, _) = task.block.position, task.bowl.position
        assert math.dist((x, y), (bowl_x, bowl_y)) >= 0.17
        assert max(abs(bowl_x - 0.45), abs(bowl_y)) <= 0.065 + 1e-9
        assert max(abs(x - 0.45), abs(y)) <= 0.09 + 1e-9


def lay(env, offset, z, yaw=0.3):
    """Place the block near the axis of the bowl and simulate until it is at rest."""
    task, world = env.scene.task, env.scene.world
    env.scene.controller.reset(((0.45, 0.1, 0.24), 0.0))
    task.bowl.place((0.45, -0.05, 0.035))
    task.block.place((0.45 + offset, -0.05, z), yaw)
    assert world.settle(400)


def test_success_requires_the_block_inside_the_upright_bowl(env):
    task, world = env.scene.task, env.scene.world
    lay(env, 0.0, FLOOR_M + 0.03)
    assert task.is_success()
    for x, z in ((0.0, 0.2), (0.075, 0.095 + 2e-4)):  # above the bowl, on its rim
        task.block.place((0.45 + x, -0.05, z))
        world.step(2)
        assert not task.is_success()
    lay(env, 0.12, 0.025)
    assert not task.is_success()  # beside the bowl
    task.block.place((0.45, -0.05, 0.025))
    task.bowl.place((0.45, -0.05, 0.05 + 0.0355))
    world.step(20)
    assert task.bowl.touches(task.block)
    assert task.bowl.tilt_rad < task.upright_rad
    assert not task.is_success()  # under the bowl


def test_a_held_block_is_not_a_success(env):
    scene, task = env.scene, env.scene.task
    lay(env, 0.0, FLOOR_M + 0.03, yaw=0.0)
    x, y, z = task.block.position
    scene.controller.reset(((x, y, z + 0.05), 0.0))
    scene.controller.move_to((x, y, z), 0.0)
    assert task.is_success()
    scene.controller.grip(0.0)
    assert scene.robot.held_body() is task.block
    assert task.bowl.touches(task.block)
    assert not task.is_success()


@pytest.mark.parametrize(("tilt", "returns"), [(0.6, True), (2.5, False)])
def test_a_tilted_bowl_returns_upright_and_a_tipped_one_ends_the_episode(env, tilt, returns):
    task = env.scene.task
    env.scene.controller.reset(((0.45, 0.1, 0.24), 0.0))
    task.bowl.set_pose((0.45, -0.05, 0.06), pybullet.getQuaternionFromEuler((tilt, 0.0, 0.0)))
    env.scene.world.settle(400)
    assert (task.bowl.tilt_rad < 0.02) is returns
    assert (task.bowl.tilt_rad > task.tipped_rad) is not returns
    outcome = env._step(env.full_action_spec.zero())
    assert outcome["terminated"] != returns
    assert not outcome["success"]


@pytest.mark.parametrize("bearing", np.arange(8) * math.pi / 4)
def test_the_expert_grasps_a_block_beside_the_bowl_and_does_not_move_it(env, bearing):
    task, bowl = env.scene.task, (0.45, 0.0)
    task.bowl.place((*bowl, 0.035))
    xy = PlanarFrame(*bowl, bearing).to_world(0.118, 0.0)
    task.block.place((*xy, 0.025), bearing)
    env.scene.world.settle()
    before, state, steps = task.bowl.position, env._step(env.full_action_spec.zero()), 0
    while not task.robot.held_body():
        (state,) = follow(env, state, 1)
        steps += 1
    assert math.dist(before, task.bowl.position) < 2e-3
    seen = follow(env, state)
    assert seen[-1]["success"]
    assert steps + len(seen) < 25
