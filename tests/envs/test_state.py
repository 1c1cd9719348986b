"""get_state and set_state: the same state and the same actions give the same steps."""

import pytest
import torch

import ba_torchrl
from ba_torchrl.errors import SimulationError


def play(env, state, actions):
    """Return the observations after ``actions``, and the final poses of the bodies."""
    seen = []
    for action in actions:
        state = env.step(state.clone().set("action", action))["next"]
        seen.append(state)
        if state["done"]:
            break
    return seen, [body.pose for body in env.scene.world.bodies]


def same(first, second):
    (a, poses_a), (b, poses_b) = first, second
    return (
        poses_a == poses_b
        and len(a) == len(b)
        and all((x == y).all() for x, y in zip(a, b, strict=True))
    )


@pytest.mark.parametrize("task", ba_torchrl.list_tasks())
def test_a_state_and_its_actions_determine_the_steps(task):
    # enough steps, also where an episode has one
    env = ba_torchrl.make(task, obs_size=32, seed=0, expert=True, max_steps=50)
    generator = torch.Generator().manual_seed(0)
    for grasped_object in (0, 3, 5):  # before, near and after a grasp
        state = env.reset()
        for _ in range(grasped_object):
            state = env.step(state.set("action", state["expert_action"]))["next"]
            if state["done"]:
                state = env.reset()
        kept = env.get_state()
        low, high = env.action_spec.space.low, env.action_spec.space.high
        drawn = torch.rand(12, len(low), generator=generator) * (high - low) + low
        actions, others = drawn[:6], drawn[6:]
        first = play(env, state, actions)
        returned = env.set_state(kept)
        assert (returned == state.select(*returned.keys())).all()
        away = play(env, returned, others)
        second = play(env, env.set_state(kept), actions)
        assert same(first, second)
        assert not same(first, away)
    env.close()


def expert_steps(env, state, count):
    """Return the steps of the expert, over several episodes."""
    for _ in range(count):
        state = env.step(state.set("action", state["expert_action"]))["next"]
        if state["done"]:
            state = env.reset()
    return state


@pytest.mark.parametrize(
    "task",
    [
        "open_loop/bin_packing",
        "open_loop/object_grasping",
        "open_loop/bottle_arrangement",
        "close_loop/object_grasping",
        "close_loop/block_in_bowl",
    ],
)
def test_a_restored_state_does_not_depend_on_intermediate_steps(task):
    env = ba_torchrl.make(task, obs_size=32, seed=0, expert=True)
    expert_steps(env, env.reset(), 4)
    kept, futures = env.get_state(), []
    for away in (5, 0):
        state, poses = env.set_state(kept), []
        for _ in range(8):
            state = expert_steps(env, state, 1)
            poses.append([body.pose for body in env.scene.world.bodies])
        futures.append(poses)
        expert_steps(env, env.reset(), away)
    assert futures[0] == futures[1]
    env.close()


@pytest.mark.parametrize("task", ["open_loop/bin_packing", "open_loop/object_grasping"])
@pytest.mark.parametrize("seed", range(5))
def test_states_and_episodes_with_many_contacts_do_not_depend_on_earlier_motion(task, seed):
    # with the search tree of Bullet, some of these differ
    env = ba_torchrl.make(task, obs_size=32, seed=seed, expert=True)

    def future(state):
        poses = []
        for _ in range(8):
            state = expert_steps(env, state, 1)
            poses.append([body.pose for body in env.scene.world.bodies])
        return poses

    state = env.reset()
    start = [body.pose for body in env.scene.world.bodies]
    expert_steps(env, state, seed)
    kept, futures = env.get_state(), []
    for away in (0, 7, 3):
        futures.append(future(env.set_state(kept)))
        expert_steps(env, env.reset(), away)
    assert futures[0] == futures[1] == futures[2]
    env.set_seed(seed)
    env.reset()
    assert [body.pose for body in env.scene.world.bodies] == start
    env.close()


@pytest.mark.parametrize("task", ["open_loop/object_grasping", "close_loop/object_grasping"])
def test_a_state_of_a_heap_survives_another_seed(task):
    env = ba_torchrl.make(task, obs_size=32, seed=0)
    first = env.reset()["pixels"]
    kept = env.get_state()
    env.set_seed(1)
    assert not torch.equal(env.reset()["pixels"], first)
    assert torch.equal(env.set_state(kept)["pixels"], first)
    env.close()


def test_an_action_can_be_undone_by_restoring_the_state():
    tried = ba_torchrl.make("close_loop/block_picking", obs_size=32, seed=0, expert=True)
    plain = ba_torchrl.make("close_loop/block_picking", obs_size=32, seed=0, expert=True)
    a, b = tried.reset(), plain.reset()
    while not a["done"]:
        kept = tried.get_state()
        plain.get_state()  # keeping a state is itself felt in the last bits
        tried.step(a.clone().set("action", torch.tensor([-1.0, 0.3, -0.8, -1.0, 0.5])))
        a = tried.set_state(kept)
        a = tried.step(a.set("action", a["expert_action"]))["next"]
        b = plain.step(b.set("action", b["expert_action"]))["next"]
        assert (a == b).all()
    assert a["success"]
    assert torch.equal(tried.reset()["pixels"], plain.reset()["pixels"])  # the next episode, too
    tried.close()
    plain.close()


def test_a_state_keeps_how_its_episode_ended():
    env = ba_torchrl.make("close_loop/block_picking", obs_size=32, seed=0, max_steps=1)
    last = env.step(env.reset().set("action", torch.zeros(5)))["next"]
    kept = env.get_state()
    env.reset()
    returned = env.set_state(kept)
    assert last["truncated"]
    assert returned["truncated"]
    assert returned["done"]
    assert returned["step_count"] == 1
    env.close()


def test_a_state_of_another_environment_is_refused():
    first, second = (ba_torchrl.make("close_loop/block_picking", obs_size=32) for _ in range(2))
    first.reset()
    with pytest.raises(SimulationError, match="another environment"):
        second.set_state(first.get_state())
    with pytest.raises(SimulationError, match="reset"):
        second.get_state()
    first.close()
    second.close()


def test_deleted_states_free_their_memory():
    import pybullet

    env = ba_torchrl.make("close_loop/block_picking", obs_size=32, seed=0)
    env.reset()
    kept = env.get_state()
    number, client = kept.scene.world.id, env.scene.world.client
    del kept
    with pytest.raises(pybullet.error):
        pybullet.restoreState(number, physicsClientId=client)
    env.close()
