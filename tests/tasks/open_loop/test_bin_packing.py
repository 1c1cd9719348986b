"""Bin packing: when an object is packed, release heights, kinds of objects."""

import math

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view

from ba_torchrl.sim.geometry import yaw_quaternion
from ba_torchrl.tasks.manipulation.footprints import Rectangle, outline
from ba_torchrl.tasks.open_loop.bin_packing import BIN_M, BinPacking, _window_maxima, object_shapes
from ba_torchrl.testing.labels import offset_of
from tests.tasks.episodes import follow
from tests.tasks.packing.scenes import BIN, QUARTER_TURN


def filled_bin(make_env, count=4):
    """Return an environment with all objects side by side on the bin's floor."""
    env = make_env(BIN, num_objects=count)
    env.reset()
    task = env.scene.task
    bin_yaw = task.container.yaw_rad
    inside = Rectangle(*task.container.position[:2], bin_yaw, 0.0, 0.0)
    cells = [(x, y) for x in (-0.06, 0.0, 0.06) for y in (-0.025, 0.025)]
    for body, cell in zip(task.objects, cells, strict=False):
        low = body.shape.bounds_m[0][2]
        body.place((*inside.frame.to_world(*cell), 0.004 - low), bin_yaw)
    for body, cell in zip(task.objects, cells, strict=False):
        if body.shape.bounds_m[1][1] > 0.03:  # long ones would overlap: they stand on an end
            turn = yaw_quaternion(bin_yaw)
            x, y, _, w = QUARTER_TURN
            sz, cz = turn[2], turn[3]
            body.set_pose(
                (*inside.frame.to_world(*cell), 0.044),
                (cz * x - sz * y, cz * y + sz * x, sz * w, cz * w),
            )
    env.scene.world.settle()
    return env, task, inside


def test_objects_beside_the_bin_over_its_wall_and_on_its_rim_are_not_packed(make_env):
    _, task, inside = filled_bin(make_env)
    assert task.is_success()
    assert task.is_valid()
    body = task.objects[0]
    floor, rim = -body.shape.bounds_m[0][2], BIN_M[2] - body.shape.bounds_m[0][2]
    for along, z in (
        (BIN_M[0] / 2 + 0.022, floor),  # against the outside of the wall
        (BIN_M[0] / 2 - 0.01, floor),
        (BIN_M[0] / 2 - 0.01, rim),
        (BIN_M[0] / 2 - 0.015, rim),  # its centre is inside, its end rests on the rim
        (0.0, rim + 0.001),  # entirely above the rim
    ):
        body.place((*inside.frame.to_world(along, 0.0), z), inside.yaw_rad)
        assert not task.is_packed(body)
        assert not task.is_success()


def test_a_held_object_is_not_packed(make_env):
    env = make_env(BIN, num_objects=1)
    state = env.reset()
    (picked,) = follow(env, state, 1)
    assert picked["holding"]
    assert not env.scene.task.is_success()


def test_objects_are_released_above_the_rim_or_on_the_surface(make_env):
    env = make_env(BIN, num_objects=2)
    follow(env, env.reset(), 1)
    task = env.scene.task
    depth = task.depth_m(env.scene.controller.held)
    assert task.place_height_m(0.0, (0.4, 0.0)) == pytest.approx(depth, abs=2e-3)
    assert task.place_height_m(0.004, (0.4, 0.0)) > BIN_M[2] + 0.009  # the fingertips
    assert task.place_height_m(0.12, (0.4, 0.0)) == pytest.approx(0.12 + depth, abs=2e-3)


def test_kinds_are_drawn_with_replacement(make_env):
    env = make_env(BIN)
    seen = []
    for _ in range(12):
        env.reset()
        seen.append([body.name.split()[0] for body in env.scene.task.objects])
    assert all(len(kinds) == 8 for kinds in seen)
    assert {kind for kinds in seen for kind in kinds} == set(object_shapes(1.0))
    assert any(kinds.count(kind) >= 3 for kinds in seen for kind in kinds)


def test_the_expert_decides_by_what_the_image_shows(make_env):
    env = make_env(BIN)
    state = env.reset()
    task, seen = env.scene.task, []
    while not state["done"]:
        held, scene = env.scene.controller.held, env.get_state()
        for body in task.objects:
            width, length, _ = body.shape.bounds_m[1]
            if body is not held and length == pytest.approx(width):
                seen.append(body)  # cubes and tiles look the same after a quarter turn
                body.place(body.position, body.yaw_rad + math.pi / 2)
        with env.scene.world.fixed_poses():
            label = env.actions.encode(task.expert_command())
        offset = offset_of(env.actions, label, state["expert_action"].numpy())
        assert not offset.is_jump
        env.reset(scene, set_state=True)
        (state,) = follow(env, state, 1)
    assert state["success"]
    assert len(seen) > 10


def test_any_of_the_equal_moves_solves_the_task(make_env):
    env = make_env(BIN)
    state, counts = env.reset(), {False: [], True: []}
    while not state["done"]:
        moves = state["expert_moves"]
        assert moves.shape == (BinPacking.equal_moves, 4)
        assert torch.equal(moves[0], state["expert_action"])
        different = moves.unique(dim=0)
        task, held = env.scene.task, env.scene.controller.held
        counts[held is not None].append(len(different))
        aims = [task.container] if held is not None else task.objects
        for at in different[:, 1:3].numpy():
            assert any(outline(body).contains(at[None]) for body in aims)
        (state,) = follow(env, state, 1, action=different[len(different) // 2])
    assert state["success"]
    assert max(counts[False]) > 1
    assert max(counts[True]) > 8


def test_equal_sites_are_filled_from_the_corner_farthest_from_the_workspaces_centre(make_env):
    env = make_env(BIN)
    for _ in range(2):
        follow(env, env.reset(), 1)
        task, frame = env.scene.task, env.scene.task.container_outline().frame
        command = task.expert_command()
        site = frame.to_local(command.x_m, command.y_m)
        center = frame.to_local(*task.settings.workspace.center)
        assert np.sign(site).tolist() == [-np.sign(value) for value in center]


@pytest.mark.parametrize("size", [1, 2, 3, 7, 8, 9, 20])
def test_maxima_of_windows(size):
    values = np.random.default_rng(0).normal(size=(20, 5))
    expected = sliding_window_view(values, size, axis=0).max(axis=-1)
    np.testing.assert_array_equal(_window_maxima(values, size), expected)
