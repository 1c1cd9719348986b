"""The heap of object grasping in both controls: over episodes, object sets, seeds, states."""

import hashlib
import math

import numpy as np
import pytest
import torch

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.assets.household import ITEMS
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.meshes import box_mesh, write_obj
from ba_torchrl.tasks.clutter.base import DROP_Z_M
from ba_torchrl.tasks.terrain.tray import FLOOR_Z_M
from tests.tasks.episodes import play

NO_OPS = {
    "close_loop": torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0]),
    "open_loop": torch.tensor([1.0, 0.45, 0.0, 0.0]),  # a place with an empty gripper
}
OTHER = {
    "close_loop": torch.tensor([-1.0, 0.2, -0.1, -1.0, 0.3]),
    "open_loop": torch.tensor([0.0, 0.46, 0.02, 0.4]),
}
"""Actions that may move objects."""
DEFAULT_COUNT = {"close_loop": 5, "open_loop": 15}


both_controls = pytest.mark.parametrize("control", ["close_loop", "open_loop"], indirect=True)


@pytest.fixture
def control(request):
    return getattr(request, "param", "close_loop")


@pytest.fixture
def make(make_env, control):
    """Return a function that makes an environment, with an expert if asked for."""
    size = {"close_loop": 32, "open_loop": 128}[control]

    def build(**config):
        task = f"{control}/object_grasping"
        return make_env(task, **{"obs_size": size, "seed": 0, "expert": False, **config})

    return build


def names(env):
    return [body.name for body in env.scene.task.objects]


def digest(env):
    poses = [(body.name, body.pose) for body in env.scene.task.objects]
    return hashlib.sha256(repr(poses).encode()).hexdigest()


@pytest.mark.parametrize("count", [1, 5, 15])
def test_a_heap_of_different_objects_lies_still_in_the_tray(make, count):
    env = make(num_objects=count)
    half_m = env.workspace.width / 2
    seen, tilts = set(), []
    for seed in range(3):
        env.reset(seed=seed)
        objects = env.scene.task.objects
        assert len(set(names(env))) == count
        seen.update(names(env))
        tilts += [body.tilt_rad for body in objects]
        before = [body.position for body in objects]
        env.scene.world.step(30)
        for body, position in zip(objects, before, strict=True):
            assert math.dist(body.position, position) < 6e-3
            assert abs(body.position[0] - 0.45) < half_m
            assert abs(body.position[1]) < half_m
            assert FLOOR_Z_M < body.position[2] < 0.2
    assert len(seen) > 2 * count
    assert count == 1 or max(tilts) > 1.2


@both_controls
def test_only_active_objects_are_visible_and_the_arm_is_outside_of_the_image(make):
    env = make(num_objects=2)
    env.reset()
    world = env.scene.world
    shown = [body for body in world.bodies if not body.is_static and not body.is_hidden]
    assert shown == sorted(env.scene.task.objects, key=world.bodies.index)
    assert len(world.bodies) == 86 + 2
    assert all(body.position[2] > 1e5 for body in world.bodies if body.is_hidden)
    assert world.is_still()
    assert env.scene.camera.heightmap((0.45, 0.0), 0.2, 64).max() < 0.12


@both_controls
def test_the_number_of_objects_is_limited(make, control):
    for count in (0, {"close_loop": 16, "open_loop": 21}[control]):
        with pytest.raises(ConfigError, match="num_objects"):
            make(num_objects=count)


def test_objects_with_fixed_orientations_fall_into_a_heap(make, monkeypatch):
    env, dropped = make(random_orientation=False, num_objects=15), []
    original = Body.set_pose

    def set_pose(body, position, orientation):
        dropped.append((position[2], orientation))
        original(body, position, orientation)

    monkeypatch.setattr(Body, "set_pose", set_pose)
    env.reset(seed=0)
    assert dropped.count((DROP_Z_M, (0.0, 0.0, 0.0, 1.0))) >= 15
    monkeypatch.undo()
    assert max(body.tilt_rad for body in env.scene.task.objects) > 0.5
    boxes = [np.array(body.bounding_box())[:, :2] for body in env.scene.task.objects]
    overlaps = [
        not ((low > other_high) | (other_low > high)).any()
        for i, (low, high) in enumerate(boxes)
        for other_low, other_high in boxes[:i]
    ]
    assert sum(overlaps) > 5


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


@both_controls
def test_the_grasped_object_is_removed_and_the_others_stay(make, control):
    env = make(expert=True)
    assert play(env, env.reset())["success"]
    grasped = env.scene.robot.held_body()
    others = [body for body in env.scene.task.objects if body is not grasped]
    # in close loop, one that was lifted with it can still be falling
    resting = {
        body: body.position
        for body in others
        if control == "open_loop" or body.is_still(speed_m_s=0.01, spin_rad_s=0.2)
    }
    assert len(resting) >= len(others) - 1
    state = env.reset()
    assert names(env) == [body.name for body in others]
    *_, (corner, _) = env.scene.task.landmarks  # that of the removed object
    assert corner == tuple(high for _, high in env.config.workspace)
    assert len(env.scene.task.landmarks) == env.config.num_objects
    assert not state["holding"]
    assert grasped.is_hidden  # also after the gripper has opened
    assert grasped.position[2] > 1e5
    for body, position in resting.items():
        assert math.dist(body.position, position) < 5e-3
    assert not env.scene.task.is_success()


def test_new_objects_fall_when_the_tray_is_empty(make):
    env = make(expert=True, num_objects=2, object_set="household")
    state, heaps = env.reset(), []
    for _ in range(12):
        heaps.append(frozenset(names(env)))
        grasped = bool(play(env, state)["success"])
        state = env.reset()
        if grasped:
            assert len(names(env)) == (2 if len(heaps[-1]) == 1 else 1)
    assert sum(len(heap) == 1 for heap in heaps) >= 3
    assert len({heap for heap in heaps if len(heap) == 2}) >= 2


def test_the_heap_is_replaced_after_the_configured_number_of_attempts(make, control):
    env = make(num_objects=3, max_attempts=3, max_steps=2)
    state, heaps = env.reset(), []
    for _ in range(7):
        heaps.append(tuple(names(env)))
        play(env, state, NO_OPS[control])
        state = env.reset()
    assert len(set(heaps[:3])) == len(set(heaps[3:6])) == 1
    assert len({heaps[0], heaps[3], heaps[6]}) == 3


@both_controls
def test_an_object_outside_the_workspace_ends_the_episode_and_replaces_the_heap(make, control):
    env = make()
    state = env.reset()
    before = names(env)
    env.scene.task.objects[0].place((0.45, 0.5, 0.05))
    state = env.step(state.set("action", NO_OPS[control]))["next"]
    assert state["terminated"]
    assert not state["success"]
    assert not env.scene.task.is_valid()
    env.reset()
    assert len(names(env)) == DEFAULT_COUNT[control]
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
def test_when_a_heap_is_replaced(make, monkeypatch, present, attempts, succeeds, should_continue):
    env = make(num_objects=present, max_attempts=3)
    env.reset()
    task = env.scene.task
    task.attempts = attempts
    grasped_object = task.pool.active[0] if succeeds else None
    monkeypatch.setattr(task, "grasped_object", lambda: grasped_object)
    assert task.continues is should_continue
    task.resume()
    assert task.attempts == attempts + 1
    assert len(task.pool.active) == present - succeeds


def test_a_seed_reproduces_the_heap_exactly(make, control):
    env, other = make(), make()
    env.reset(seed=5)
    first = digest(env)
    play(env, env.reset(seed=1), OTHER[control])  # another heap and a continued one in between
    env.reset()
    env.reset(seed=5)
    assert digest(env) == first
    other.reset(seed=5)
    assert digest(other) == first
    env.reset(seed=6)
    assert digest(env) != first


@both_controls
def test_the_episode_after_a_restored_success_is_the_same(make):
    env = make(expert=True)
    assert play(env, env.reset())["success"]
    kept, grasped = env.get_state(), env.scene.robot.held_body().name
    env.reset()
    present = names(env)
    play(env, env.reset())
    env.reset(kept, set_state=True)
    held = env.scene.robot.held_body()
    assert held.name == grasped
    env.reset()  # the held object counts as grasped without a new contact query
    assert names(env) == present
    assert held.is_hidden
