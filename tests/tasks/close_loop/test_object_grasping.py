"""Close-loop object grasping: the heap over episodes, state, conditions of success, expert."""

import hashlib
import math

import numpy as np
import pytest
import torch

import ba_torchrl
from ba_torchrl.errors import ConfigError
from ba_torchrl.sim.assets.household import ITEMS
from ba_torchrl.sim.meshes import box_mesh, write_obj
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.tasks.terrain.tray import FLOOR_Z_M

TASK = "close_loop/object_grasping"
NO_OP = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture
def make():
    envs = []

    def build(**config):
        env = ba_torchrl.make(TASK, **{"obs_size": 32, "seed": 0, **config})
        envs.append(env)
        return env

    yield build
    for env in envs:
        env.close()


def names(env):
    return [body.name for body in env.scene.task.clutter.pool.active]


def fingerprint(env):
    poses = [(body.name, body.pose) for body in env.scene.task.clutter.pool.active]
    return hashlib.sha256(repr(poses).encode()).hexdigest()


def finish(env, state, action=None):
    """Act until the episode ends, with expert actions or with the given one."""
    while not state["done"]:
        chosen = state["expert_action"] if action is None else action
        state = env.step(state.set("action", chosen))["next"]
    return state


# -- the heap -----------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 5, 15])
def test_a_heap_of_different_objects_lies_still_in_the_tray(make, count):
    env = make(num_objects=count)
    for seed in range(4):
        env.reset(seed=seed)
        objects = env.scene.task.objects
        assert len(set(names(env))) == count
        before = [body.position for body in objects]
        env.scene.world.step(30)
        for body, position in zip(objects, before, strict=True):
            assert math.dist(body.position, position) < 6e-3
            assert abs(body.position[0] - 0.45) < 0.15
            assert abs(body.position[1]) < 0.15
            assert FLOOR_Z_M < body.position[2] < 0.2


def test_objects_and_poses_are_random(make):
    env = make()
    seen, tilts = set(), []
    for seed in range(12):
        env.reset(seed=seed)
        seen.update(names(env))
        tilts += [body.tilt_rad for body in env.scene.task.objects]
    assert len(seen) > 30
    assert max(tilts) > 1.2


def test_objects_with_fixed_orientations_fall_into_a_heap(make):
    env = make(random_orientation=False)
    tilts = []
    for seed in range(6):
        env.reset(seed=seed)
        tilts += [body.tilt_rad for body in env.scene.task.objects]
    assert np.mean(np.array(tilts) > 0.2) > 0.1  # they tumble


def test_only_active_objects_are_visible(make):
    env = make(num_objects=2)
    env.reset()
    shown = [body for body in env.scene.world.bodies if not body.is_static and not body.is_hidden]
    assert shown == sorted(env.scene.task.objects, key=env.scene.world.bodies.index)
    assert len(env.scene.world.bodies) == 86 + 2
    for body in env.scene.world.bodies:
        if body.is_hidden:
            assert body.position[2] > 1e5
    assert env.scene.world.is_still()
    heights = env.scene.camera.heightmap((0.45, 0.0), 0.2, 64)
    assert heights.max() < 0.12  # without arm, gripper and inactive objects


@pytest.mark.parametrize("count", [0, 16])
def test_the_number_of_objects_is_limited(make, count):
    with pytest.raises(ConfigError, match="num_objects"):
        make(num_objects=count)


def test_the_arm_is_at_its_start_after_the_drop(make):
    env = make()
    env.reset()
    position, yaw = env.scene.robot.tool_pose()
    assert math.dist(position, (0.45, 0.0, 0.2)) < 1e-3
    assert abs(yaw) < 1e-3
    assert env.scene.robot.opening() > 0.95


def test_household_and_graspnet_objects(make, tmp_path):
    assert set(names_after_reset(make(object_set="household"))) <= set(ITEMS)
    for name, size in (("a", (0.04, 0.05, 0.06)), ("b", (0.03, 0.03, 0.08))):
        (tmp_path / name).mkdir()
        write_obj(tmp_path / name / "mesh.obj", [box_mesh(size)])
    found = names_after_reset(make(object_set="graspnet", asset_root=str(tmp_path)))
    assert len(found) == 5  # copies of a set of two
    assert len(set(found)) == 5
    assert {name[0] for name in found} == {"a", "b"}
    with pytest.raises(ConfigError, match="asset_root"):
        make(object_set="graspnet")


def names_after_reset(env):
    env.reset()
    return names(env)


# -- over episodes ------------------------------------------------------------------------------


def test_the_lifted_object_is_removed_and_the_others_stay(make):
    env = make(expert=True)
    state = finish(env, env.reset())
    assert state["success"]
    lifted = env.scene.robot.held_body()
    others = [body for body in env.scene.task.objects if body is not lifted]
    # one that was lifted with it can still be falling
    resting = {b: b.position for b in others if b.is_still(speed_m_s=0.01, spin_rad_s=0.2)}
    assert len(resting) >= len(others) - 1
    env.reset()
    assert names(env) == [body.name for body in others]
    assert lifted.is_hidden
    for body, position in resting.items():
        assert math.dist(body.position, position) < 5e-3
    assert not env.scene.task.is_success()


def test_new_objects_are_dropped_into_an_empty_tray(make):
    env = make(expert=True, num_objects=2)
    state, counts = env.reset(), []
    for _ in range(4):
        counts.append(len(names(env)))
        state = finish(env, state)
        assert state["success"]
        state = env.reset()
    assert counts == [2, 1, 2, 1]


def test_the_heap_is_replaced_after_the_configured_number_of_attempts(make):
    env = make(max_steps=2, max_attempts=3)
    state, heaps = env.reset(), []
    for _ in range(7):
        heaps.append(tuple(names(env)))
        assert finish(env, state, NO_OP)["truncated"]
        state = env.reset()
    assert heaps[0] == heaps[1] == heaps[2] != heaps[3]
    assert heaps[3] == heaps[4] == heaps[5] != heaps[6]


@pytest.mark.parametrize(("count", "limit"), [(1, 2), (4, 6), (5, 8)])
def test_the_default_number_of_attempts_is_one_and_a_half_per_object(make, count, limit):
    env = make(max_steps=1, num_objects=count)
    state, heaps = env.reset(), []
    for _ in range(limit + 1):
        heaps.append(tuple(names(env)))
        finish(env, state, NO_OP)
        state = env.reset()
    assert len(set(heaps[:limit])) == 1
    assert heaps[limit] != heaps[0]


def test_a_success_is_an_attempt(make):
    env = make(expert=True, max_attempts=4)
    state = env.reset()
    first = set(names(env))
    finish(env, state, NO_OP)
    finish(env, env.reset(), NO_OP)
    assert finish(env, env.reset())["success"]
    state = env.reset()
    assert len(names(env)) == 4
    assert set(names(env)) < first
    assert env.scene.task.get_state()[1:] == (3, 0)
    assert finish(env, state)["success"]
    env.reset()
    assert len(names(env)) == 5
    assert env.scene.task.get_state()[1:] == (0, 0)


def test_an_object_outside_the_workspace_ends_the_episode_and_replaces_the_heap(make):
    env = make()
    state = env.reset()
    before = names(env)
    env.scene.task.objects[0].place((0.45, 0.3, 0.05))
    state = env.step(state.set("action", NO_OP))["next"]
    assert state["terminated"]
    assert not state["success"]
    env.reset()
    assert len(names(env)) == 5
    assert names(env) != before


def test_low_objects_are_valid_and_high_ones_are_not(make):
    env = make(num_objects=1)
    env.reset()
    (body,) = env.scene.task.objects
    for z, valid in ((0.008, True), (0.24, True), (0.26, False)):
        body.place((0.45, 0.0, z))
        assert env.scene.task.is_valid() is valid
    checked = make(num_objects=1, workspace_check="bounding_box")
    checked.reset()
    (body,) = checked.scene.task.objects
    body.place((0.45, 0.145, 0.05))
    assert not checked.scene.task.is_valid()


def test_a_seed_reproduces_the_heap_exactly(make):
    env, other = make(), make()
    env.reset(seed=5)
    first = fingerprint(env)
    for seed in (1, 2):  # with other heaps and continued ones in between
        state = env.reset(seed=seed)
        finish(env, state, torch.tensor([-1.0, 0.2, -0.1, -1.0, 0.3]))
        env.reset()
        env.reset(seed=5)
        assert fingerprint(env) == first
    other.reset(seed=5)
    assert fingerprint(other) == first
    env.reset(seed=6)
    assert fingerprint(env) != first


# -- state --------------------------------------------------------------------------------------


def test_a_state_restores_the_active_objects(make):
    env = make(expert=True)
    state = finish(env, env.reset())
    state = env.reset()
    saved, active = env.get_state(), names(env)
    pixels, before = state["pixels"].clone(), fingerprint(env)
    for _ in range(6):
        finish(env, env.reset())
    assert names(env) != active
    state = env.set_state(saved)
    assert names(env) == active
    assert fingerprint(env) == before
    assert torch.equal(state["pixels"], pixels)
    assert [b.is_hidden for b in env.scene.task.clutter.pool.bodies] == [
        b.name not in active for b in env.scene.task.clutter.pool.bodies
    ]
    finish(env, state)
    env.reset()
    assert len(names(env)) in (3, 4, 5)


def test_the_vector_observation_keeps_its_length(make):
    env = make(obs_type="vec", expert=True, num_objects=3)
    state = env.reset()
    assert state["observation"].shape == (1 + 4 * 4,)
    state = finish(env, state)
    assert state["success"]
    state = env.reset()
    assert state["observation"].shape == (1 + 4 * 4,)
    assert state["observation"][-4:].tolist() == [
        1.0,
        1.0,
        1.0,
        0.0,
    ]  # the upper corner


# -- success ------------------------------------------------------------------------------------


def test_success_requires_a_grasp_and_a_height(make):
    env = make(num_objects=1, object_set="household")
    env.reset()
    scene = env.scene
    task = scene.task
    assert not task.is_success()
    scene.controller.reset(((0.45, 0.0, 0.2), 0.0))
    assert not task.is_success()  # high, without an object
    brick = next(body for body in task.clutter.pool.bodies if body.name == "brick")
    task.clutter.pool.deactivate(task.objects[0])
    task.clutter.pool.activate(brick)
    brick.place((0.45, 0.0, FLOOR_Z_M + 0.02))
    scene.world.settle()
    scene.controller.move_to((0.45, 0.0, 0.02), 0.0)
    scene.controller.grip(0.0)
    scene.controller.move_to((0.45, 0.0, 0.08), 0.0)
    scene.controller.move_to((0.45, 0.0, 0.14), 0.0)
    assert not task.is_success()  # held, at a low height
    scene.controller.move_to((0.45, 0.0, 0.16), 0.0)
    assert task.is_success()
    scene.controller.grip(1.0)
    scene.world.settle()
    assert not task.is_success()


# -- expert -------------------------------------------------------------------------------------


def play(env, episodes):
    outcomes = []
    for _ in range(episodes):
        state = finish(env, env.reset())
        outcomes.append((bool(state["success"]), int(state["step_count"])))
    steps = [steps for success, steps in outcomes if success]
    return len(steps) / episodes, float(np.mean(steps))


def test_the_expert_is_as_fast_as_the_published_planner(make):
    success, steps = play(make(expert=True), 40)
    assert success >= 0.95
    assert steps <= 1.1 * 14.2


@pytest.mark.parametrize("robot", [name for name in ROBOTS if name != "kuka"])
def test_the_expert_succeeds_with_every_robot(make, robot):
    success, steps = play(make(expert=True, robot=robot), 25)
    assert success >= 0.9
    assert steps <= 1.1 * 14.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "least"),
    [
        ({}, 0.95),
        ({"random_orientation": False, "action_sequence": "pxyz"}, 0.9),
        ({"random_orientation": False}, 0.95),
        ({"num_objects": 15}, 0.95),
        ({"object_set": "household"}, 0.88),  # 0.92, 0.92, 0.94 and 0.98 with four seeds
    ],
    ids=["random", "fixed, without yaw", "fixed", "15 objects", "household"],
)
def test_the_expert_over_200_episodes(make, config, least):
    success, steps = play(make(expert=True, **config), 200)
    assert success >= least
    assert steps <= 1.1 * 14.2
