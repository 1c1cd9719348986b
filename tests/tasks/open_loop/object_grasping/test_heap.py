"""The heap over episodes: objects removed and replaced, object sets, seeds, states."""

import math

import numpy as np
import pytest
import torch

from ba_torchrl.errors import ConfigError
from ba_torchrl.sim.assets.household import ITEMS
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.meshes import box_mesh, write_obj
from ba_torchrl.tasks.clutter.base import DROP_Z_M
from tests.tasks.open_loop.object_grasping.heaps import NO_OP, names, play, poses_digest


def test_the_picked_object_is_removed_and_the_others_stay(make):
    env = make(expert=True)
    state = play(env, env.reset())
    assert state["success"]
    picked = env.scene.controller.held
    others = {body.name: body.position for body in env.scene.task.objects if body is not picked}
    assert len(others) == 14
    state = env.reset()
    assert names(env) == list(others)
    assert not state["holding"]
    assert not env.scene.task.is_success()
    for body in env.scene.task.objects:
        assert math.dist(body.position, others[body.name]) < 5e-3
    # the picked object stays hidden after the gripper opens
    assert picked.is_hidden
    assert picked.position[2] > 1e5
    assert env.scene.world.is_still()


def test_new_objects_fall_when_the_tray_is_empty(make):
    env = make(expert=True, num_objects=2, object_set="household")
    state, counts, heaps = env.reset(), [], []
    while len(counts) < 12:
        counts.append(len(names(env)))
        heaps.append(frozenset(names(env)))
        picked = bool(play(env, state)["success"])
        state = env.reset()
        if picked:
            assert len(names(env)) == (2 if counts[-1] == 1 else 1)
    assert counts.count(1) >= 3
    assert len({heap for heap in heaps if len(heap) == 2}) >= 2


def test_the_heap_is_replaced_after_the_configured_number_of_attempts(make):
    env = make(num_objects=3, max_attempts=3)
    state, heaps = env.reset(), []
    for _ in range(7):
        heaps.append(tuple(names(env)))
        assert play(env, state, NO_OP)["terminated"]
        state = env.reset()
    assert len(set(heaps[:3])) == len(set(heaps[3:6])) == 1
    assert len({heaps[0], heaps[3], heaps[6]}) == 3


def test_the_default_number_of_attempts_is_that_of_the_reference(make):
    env = make(num_objects=2)
    env.reset()
    assert env.scene.task.clutter.max_attempts == 30
    heap = names(env)
    for _ in range(5):
        play(env, env.reset(), NO_OP)
    assert names(env) == heap
    with pytest.raises(ConfigError, match="max_attempts"):
        make(max_attempts=0)


def test_a_success_is_an_attempt_and_resets_the_count_of_failures(make):
    env = make(expert=True)
    for _ in range(2):
        play(env, env.reset(), NO_OP)
    assert play(env, env.reset())["success"]
    env.reset()
    assert len(names(env)) == 14
    assert env.scene.task.clutter.attempts == 3
    assert env.scene.task.clutter.failures == 0


def test_an_object_outside_the_tray_replaces_the_heap(make):
    env = make(expert=True)
    state = env.reset()
    before = names(env)
    env.scene.task.objects[0].place((0.45, 0.5, 0.05))
    state = env.step(state.set("action", NO_OP))["next"]
    assert state["terminated"]
    assert not state["success"]
    assert not env.scene.task.is_valid()
    env.reset()
    assert len(names(env)) == 15
    assert names(env) != before


@pytest.mark.parametrize(
    ("present", "attempts", "succeeds", "should_continue"),
    [
        (2, 0, True, True),
        (1, 0, True, False),
        (2, 1, True, True),
        (2, 2, True, False),
        (1, 0, False, True),
        (2, 1, False, True),
        (2, 2, False, False),
    ],
)
def test_when_a_heap_is_replaced(make, present, attempts, succeeds, should_continue):
    env = make(num_objects=present, max_attempts=3)
    env.reset()
    clutter = env.scene.task.clutter
    clutter.attempts = attempts
    grasped_object = clutter.pool.active[0] if succeeds else None
    assert clutter.should_continue(grasped_object) is should_continue
    clutter.advance(grasped_object)
    assert clutter.attempts == attempts + 1
    assert clutter.failures == (0 if succeeds else 1)
    assert len(clutter.pool.active) == present - succeeds


def test_household_and_graspnet_objects(make, tmp_path):
    env = make(object_set="household")
    env.reset()
    assert set(names(env)) <= set(ITEMS)
    for name, size in (("a", (0.04, 0.05, 0.06)), ("b", (0.03, 0.03, 0.08))):
        (tmp_path / name).mkdir()
        write_obj(tmp_path / name / "mesh.obj", [box_mesh(size)])
    env = make(object_set="graspnet", asset_root=str(tmp_path), num_objects=5, expert=True)
    state = env.reset()
    assert sorted({name[0] for name in names(env)}) == ["a", "b"]
    assert len(set(names(env))) == 5  # a set of two is used with copies
    assert play(env, state)["success"]
    with pytest.raises(ConfigError, match="asset_root"):
        make(object_set="graspnet")


@pytest.mark.parametrize("count", [0, 21])
def test_the_number_of_objects_is_limited(make, count):
    with pytest.raises(ConfigError, match="num_objects"):
        make(num_objects=count)


def test_objects_with_fixed_orientations_fall_into_a_heap(make, monkeypatch):
    env, dropped = make(random_orientation=False), []
    original = Body.set_pose

    def set_pose(body, position, orientation):
        dropped.append((position[2], orientation))
        original(body, position, orientation)

    monkeypatch.setattr(Body, "set_pose", set_pose)
    env.reset(seed=0)
    assert dropped.count((DROP_Z_M, (0.0, 0.0, 0.0, 1.0))) >= 15
    monkeypatch.undo()
    tilts = [body.tilt_rad for body in env.scene.task.objects]
    assert max(tilts) > 0.5
    boxes = [np.array(body.bounding_box())[:, :2] for body in env.scene.task.objects]
    overlaps = [
        not ((low > other_high) | (other_low > high)).any()
        for i, (low, high) in enumerate(boxes)
        for other_low, other_high in boxes[:i]
    ]
    assert sum(overlaps) > 5


def test_a_seed_reproduces_the_heap_exactly(make):
    env, other = make(), make()
    env.reset(seed=5)
    first = poses_digest(env)
    state = env.reset(seed=1)  # another heap, with one pick, in between
    play(env, state, torch.tensor([0.0, 0.46, 0.02, 0.4]))
    env.reset()
    env.reset(seed=5)
    assert poses_digest(env) == first
    other.reset(seed=5)
    assert poses_digest(other) == first
    env.reset(seed=6)
    assert poses_digest(env) != first


def test_a_state_restores_the_heap_and_the_failures(make):
    env = make(expert=True)
    play(env, env.reset())
    play(env, env.reset(), NO_OP)
    state = env.reset()
    kept, present, before = env.get_state(), names(env), poses_digest(env)
    pixels, action = state["pixels"].clone(), state["expert_action"].clone()
    assert len(present) == 14
    for _ in range(4):
        play(env, env.reset())
    assert names(env) != present
    state = env.set_state(kept)
    assert names(env) == present
    assert poses_digest(env) == before
    assert torch.equal(state["pixels"], pixels)
    assert torch.equal(state["expert_action"], action)
    assert env.scene.task.clutter.failures == 1
    shown = [body.name for body in env.scene.task.clutter.pool.bodies if not body.is_hidden]
    assert sorted(shown) == sorted(present)


def test_the_episode_after_a_restored_success_is_the_same(make):
    env = make(expert=True)
    assert play(env, env.reset())["success"]
    kept, picked = env.get_state(), env.scene.controller.held.name
    env.reset()
    present = names(env)
    play(env, env.reset())
    env.set_state(kept)
    held = env.scene.controller.held
    assert held.name == picked
    env.reset()  # the held object counts as grasped without a new contact query
    assert names(env) == present
    assert held.is_hidden


def test_the_vector_observation_keeps_its_length(make):
    env = make(obs_type="vec", expert=True, num_objects=3)
    state = env.reset()
    length = state["observation"].shape
    assert play(env, state)["success"]
    assert env.reset()["observation"].shape == length
    assert len(names(env)) == 2
