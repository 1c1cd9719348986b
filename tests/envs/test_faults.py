"""A simulator fault ends the episode truncated, and the next one is in a new world."""

import math

import numpy as np
import pybullet
import pytest
import torch

from ba_torchrl.core.errors import RepeatedFaultError, SimulationError
from ba_torchrl.envs import faults
from ba_torchrl.envs.vector.worker import is_of_code
from ba_torchrl.sim.world import World
from ba_torchrl.testing.episodes import image_of

TASKS = {
    "close_loop/block_picking": {"obs_size": 16},
    "open_loop/block_stacking": {"obs_size": 32},
    "open_loop/bin_packing": {"obs_size": 32, "num_objects": 2},
}
TASK = "close_loop/block_picking"


@pytest.fixture
def make(make):
    return lambda task=TASK, **changes: make(task, **{"seed": 0, **TASKS[task], **changes})


def action(env):
    return env.action_spec.zero()


def step(env, state):
    return env.step(state.clone().set("action", action(env)))["next"]


def give_nan(env):
    body = env.scene.task.objects[0]
    body.set_pose((math.nan, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0))


def turn_nan(env):
    body = env.scene.task.objects[0]
    body.set_pose(body.position, (math.nan, 0.0, 0.0, 1.0))


def lose_below(env):
    body = env.scene.task.objects[0]
    body.set_pose((*body.position[:2], -3.0), (0.0, 0.0, 0.0, 1.0))


def throw(env):
    env.scene.task.objects[0].set_pose((90.0, 0.0, 40.0), (0.0, 0.0, 0.0, 1.0))


def remove(env):
    pybullet.removeBody(env.scene.task.objects[0].id, physicsClientId=env.scene.world.client)


def disconnect(env):
    pybullet.disconnect(physicsClientId=env.scene.world.client)


def break_joint(env):
    robot = env.scene.robot
    pybullet.resetJointState(robot.id, robot.arm_joints[0], math.nan, physicsClientId=robot.client)


FAULTS = [give_nan, turn_nan, lose_below, throw, remove, disconnect, break_joint]


@pytest.fixture(autouse=True)
def _every_world_is_closed(monkeypatch):
    worlds, construct = [], World.__init__

    def record(world, *args, **options):
        construct(world, *args, **options)
        worlds.append(world)

    monkeypatch.setattr(World, "__init__", record)
    yield
    assert worlds
    assert all(world.is_closed for world in worlds)


@pytest.mark.parametrize(
    ("task", "fault"),
    [
        *((TASK, fault) for fault in FAULTS),
        # the arm is moved to each pose at once, which repairs its joints
        *(("open_loop/block_stacking", fault) for fault in (give_nan, lose_below, disconnect)),
        ("open_loop/bin_packing", throw),
    ],
)
def test_a_fault_in_a_step_ends_the_episode_truncated_in_a_world_that_is_rebuilt(make, task, fault):
    env = make(task)
    state = env.reset()
    fault(env)
    following = step(env, state)
    assert following["fault"]
    assert following["truncated"]
    assert not following["terminated"]
    assert following["reward"] == 0
    for key, value in following.items():
        assert torch.isfinite(value.float()).all(), key
    assert torch.equal(image_of(following), image_of(state))  # the last valid observation
    assert env.faults == 1
    with pytest.raises(SimulationError, match="reset the environment first"):
        _ = env.scene
    state = env.reset()
    assert not state["fault"]
    assert not step(env, state)["fault"]


@pytest.mark.parametrize("fault", [give_nan, disconnect])
def test_the_episodes_after_a_fault_are_those_of_the_seed(make, fault):
    undisturbed, env = make(), make()
    expected = [undisturbed.reset(), undisturbed.reset(), undisturbed.reset()]
    state = env.reset()
    fault(env)
    step(env, state)
    for other in expected[1:]:
        assert torch.equal(env.reset()["depth"], other["depth"])


@pytest.mark.parametrize(
    ("task", "fault"), [(TASK, disconnect), (TASK, remove), ("open_loop/bin_packing", disconnect)]
)
def test_a_fault_between_two_episodes_starts_the_reset_again(make, task, fault):
    undisturbed, env = make(task), make(task)
    for each in (undisturbed, env):
        each.reset()
    expected = undisturbed.reset()
    fault(env)
    state = env.reset()
    assert torch.equal(image_of(state), image_of(expected))
    assert not step(env, state)["fault"]


def test_a_reset_that_always_fails_is_an_error(make, monkeypatch):
    env = make()

    def fail(*_):
        raise pybullet.error("no server")

    monkeypatch.setattr(faults, "MAX_CONSECUTIVE_FAULTS", 2)
    monkeypatch.setattr(env.task_class, "initialize_episode", fail)
    with pytest.raises(RepeatedFaultError, match=r"2 times in a row.*error: no server$"):
        env.reset()


def test_a_fault_in_every_episode_is_an_error(make, monkeypatch):
    monkeypatch.setattr(faults, "MAX_CONSECUTIVE_FAULTS", 3)
    env = make()

    def fail_after_a_step():
        state = step(env, env.reset())
        give_nan(env)
        return step(env, state)["fault"]

    for _ in range(2):
        assert fail_after_a_step()
        assert fail_after_a_step()
        step(env, env.reset())  # the next reset ends an undisturbed episode
    assert fail_after_a_step()
    assert fail_after_a_step()
    with pytest.raises(RepeatedFaultError, match=r"3 times in a row.*is not finite$") as raised:
        fail_after_a_step()
    assert is_of_code(raised.value)


@pytest.mark.parametrize(
    ("method", "error", "when"),
    [
        ("expert_command", TypeError("no command"), "step"),
        ("evaluate", IndexError("no such block"), "step"),
        ("instruction", KeyError("colour"), "step"),
        ("progress", ZeroDivisionError("no distance"), "step"),
        ("after_action", FloatingPointError("overflow"), "step"),
        ("is_valid", np.linalg.LinAlgError("singular"), "step"),
        ("expert_command", OverflowError("too large"), "reset"),
        ("evaluate", ValueError("no block"), "reset"),
        ("instruction", KeyError("colour"), "reset"),
        ("progress", ZeroDivisionError("no distance"), "reset"),
        ("initialize_episode", AttributeError("no block"), "reset"),
    ],
)
def test_an_error_of_a_task_is_raised_as_it_is(make, monkeypatch, method, error, when):
    env = make(expert=True, reward="dense", observations=["instruction"])
    state = env.reset()

    def wrong(*_):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(env.task_class, method, wrong)
        with pytest.raises(type(error)) as raised:
            step(env, state) if when == "step" else env.reset()
    assert raised.value is error
    assert raised.traceback[-1].name == "wrong"
    place = "episode 1, step 1" if when == "step" else "episode 2, step 0"
    assert error.__notes__ == [
        f"{TASK}, seed 0, {place}: an error of the code, not of the simulator"
    ]
    assert env.faults == 0
    assert not step(env, env.reset())["fault"]


def test_any_error_in_a_scene_that_is_not_finite_is_a_fault(make, monkeypatch):
    env = make()
    state = env.reset()

    def diverge(scene, action):
        give_nan(env)
        raise ValueError("cannot convert float NaN to integer")

    monkeypatch.setattr(env, "_act", diverge)
    assert step(env, state)["fault"]


def test_a_task_does_not_see_poses_that_are_not_finite(make, monkeypatch):
    env = make()
    state = env.reset()
    give_nan(env)
    monkeypatch.setattr(env.task_class, "after_action", lambda _: pytest.fail("it was called"))
    assert step(env, state)["fault"]


def test_an_image_that_is_not_finite_is_a_fault(make, monkeypatch):
    env = make()
    state = env.reset()
    height_map = env._images

    def spoilt(scene):
        images = height_map(scene)
        images["depth"] = images["depth"].copy()
        images["depth"][0, 3, 3] = math.nan
        return images

    with monkeypatch.context() as patch:
        patch.setattr(env, "_images", spoilt)
        following = step(env, state)
    assert following["fault"]
    assert torch.isfinite(following["depth"]).all()


@pytest.mark.parametrize("task", ["close_loop/block_picking", "open_loop/bin_packing"])
def test_an_episode_after_a_fault_continues_in_another_environment(make, task):
    first = make(task)
    state = first.reset()
    step(first, state)
    give_nan(first)
    step(first, state)
    assert first.get_position() == {"seed": first.base_seed, "episode": 1, "actions": []}
    step(first, first.reset())
    position = first.get_position()
    expected = step(first, state)

    second = make(task, seed=9)
    second.reset()
    second.continue_from(position)
    following = step(second, second.reset())
    for key, value in expected.items():
        assert torch.equal(following[key], value), key
