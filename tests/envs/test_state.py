"""get_state and reset(set_state=True): the same state and actions give the same steps."""

import copy
import pickle
from functools import partial

import pybullet
import pytest
import torch
from torchrl.envs import ParallelEnv, RewardSum, SerialEnv, StepCounter, TransformedEnv

import ba_torchrl
from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.core.errors import ConfigError, SimulationError
from ba_torchrl.envs.vector.batching import Vector
from ba_torchrl.envs.vector.make import make_vector
from tests.specs import slow_except

TASKS = slow_except(
    ba_torchrl.list_tasks(),
    ["close_loop/object_grasping", "open_loop/covid_test", "ramp/improvise_house_building_3"],
)
COPIES = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
}


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


@pytest.mark.parametrize("task", TASKS)
def test_a_state_and_its_actions_determine_the_steps(make, task):
    # enough steps, also where an episode has one
    env = make(task, obs_size=32, seed=0, expert=True, max_steps=50)
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
        returned = env.reset(kept, set_state=True)
        assert returned is kept
        assert (returned.exclude("state") == state.select(*returned.keys(), strict=False)).all()
        away = play(env, returned, others)
        second = play(env, env.reset(kept, set_state=True), actions)
        assert same(first, second)
        assert not same(first, away)


def expert_steps(env, state, count):
    """Return the steps of the expert, over several episodes."""
    for _ in range(count):
        state = env.step(state.set("action", state["expert_action"]))["next"]
        if state["done"]:
            state = env.reset()
    return state


@pytest.mark.parametrize(
    ("task", "seed"),
    [
        ("open_loop/bin_packing", 1),
        ("open_loop/object_grasping", 3),
        ("close_loop/block_in_bowl", 4),
        *(
            pytest.param(task, seed, marks=pytest.mark.slow)
            for task in ("open_loop/bin_packing", "open_loop/object_grasping")
            for seed in (0, 2, 4)
        ),
        pytest.param("open_loop/bottle_arrangement", 4, marks=pytest.mark.slow),
        pytest.param("close_loop/object_grasping", 4, marks=pytest.mark.slow),
    ],
)
def test_states_and_episodes_do_not_depend_on_earlier_motion(make, task, seed):
    # with the search tree of Bullet, those with many contacts differ
    env = make(task, obs_size=32, seed=seed, expert=True)

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
        futures.append(future(env.reset(kept, set_state=True)))
        expert_steps(env, env.reset(), away)
    assert futures[0] == futures[1] == futures[2]
    env.set_seed(seed)
    env.reset()
    assert [body.pose for body in env.scene.world.bodies] == start


def test_an_action_can_be_undone_by_restoring_the_state(make):
    tried = make("close_loop/block_picking", obs_size=32, seed=0, expert=True)
    plain = make("close_loop/block_picking", obs_size=32, seed=0, expert=True)
    a, b = tried.reset(), plain.reset()
    while not a["done"]:
        kept = tried.get_state()
        plain.get_state()  # keeping a state is itself felt in the last bits
        tried.step(a.clone().set("action", torch.tensor([-1.0, 0.3, -0.8, -1.0, 0.5])))
        a = tried.reset(kept, set_state=True)
        a = tried.step(a.set("action", a["expert_action"]))["next"]
        b = plain.step(b.set("action", b["expert_action"]))["next"]
        assert (a == b).all()
    assert a["success"]
    assert torch.equal(tried.reset()["depth"], plain.reset()["depth"])  # the next episode, too


@pytest.mark.parametrize(
    "task",
    slow_except(
        [task for task in ba_torchrl.list_tasks() if task.startswith("close_loop/")],
        ["close_loop/block_in_bowl", "close_loop/drawer_opening"],
    ),
)
def test_the_experts_chunk_is_what_it_does_next_and_leaves_the_state(make, task):
    env = make(task, obs_size=32, seed=0, expert=True, expert_chunk=3)
    plain = make(task, obs_size=32, seed=0, expert=True)
    generator, counts = torch.Generator().manual_seed(0), set()
    seen, other = env.reset(), plain.reset()
    for step in range(40):
        assert (seen.select(*other.keys()) == other).all()
        poses = [[body.pose for body in each.scene.world.bodies] for each in (env, plain)]
        assert poses[0] == poses[1]
        if other["done"]:
            break
        kept, ahead, chunk = plain.get_state(), other.clone(), []
        while len(chunk) < 3 and not (ahead["success"] or ahead["terminated"]):
            chunk.append(ahead["expert_action"])
            ahead = plain.step(ahead.set("action", chunk[-1]))["next"]
        plain.reset(kept, set_state=True)
        count = len(chunk)
        counts.add(count)
        assert torch.equal(seen["expert_chunk"][:count], torch.stack(chunk))
        assert seen["expert_chunk_mask"].tolist() == [True] * count + [False] * (3 - count)
        action = other["expert_action"].clone()
        if step == 2:  # also from a state that the expert does not reach
            action = torch.rand(action.shape, generator=generator) * 2 - 1
        seen, other = (
            each.step(state.set("action", action))["next"]
            for each, state in ((env, seen), (plain, other))
        )
    assert counts == {1, 2, 3}


def test_a_chunk_in_open_loop_is_refused():
    with pytest.raises(ConfigError, match="'expert_chunk' is for close-loop tasks"):
        ba_torchrl.make("open_loop/block_stacking", expert=True, expert_chunk=3)


def test_a_state_keeps_how_its_episode_ended(make):
    env = make("close_loop/block_picking", obs_size=32, seed=0, max_steps=1)
    last = env.step(env.reset().set("action", torch.zeros(5)))["next"]
    kept = env.get_state()
    env.reset()
    returned = env.reset(kept, set_state=True)
    assert last["truncated"]
    assert returned["truncated"]
    assert returned["done"]
    assert returned["step_count"] == 1


def test_another_environment_and_a_new_world_continue_a_state(make):
    first, second = (make("close_loop/object_grasping", obs_size=32, seed=seed) for seed in (0, 1))
    first.step(first.reset().set("action", torch.full((5,), -0.5)))
    kept, actions = first.get_state(), torch.tensor([[1.0, 0.5, 0.0, -1.0, 0.3]] * 4)
    there = pickle.loads(pickle.dumps(kept))
    expected = play(first, first.reset(kept.clone(), set_state=True), actions)
    assert same(play(second, second.reset(there, set_state=True), actions), expected)
    assert torch.equal(first.reset()["depth"], second.reset()["depth"])
    state = first.reset().set("action", torch.zeros(5))
    pybullet.disconnect(physicsClientId=first.scene.world.client)
    assert first.step(state)["next", "fault"]
    assert same(play(first, first.reset(kept, set_state=True), actions), expected)


def test_a_reset_to_no_state_of_these_parameters_is_refused(make):
    env = make("close_loop/block_picking", obs_size=32)
    other = make("close_loop/block_picking", obs_size=16)
    with pytest.raises(SimulationError, match="reset"):
        env.get_state()
    state = env.reset()
    for given in (None, state):
        with pytest.raises(ConfigError, match="needs the entry 'state'"):
            env.reset(given, set_state=True)
    with pytest.raises(ConfigError, match="another task or parameters"):
        other.reset(env.get_state(), set_state=True)
    kept = env.get_state()
    with pytest.raises(ConfigError, match="list_of_kwargs"):
        env.reset(set_state=True, state=torch.stack([kept, kept]))
    with pytest.raises(ConfigError, match="needs set_state=True"):  # not a new episode
        env.reset(state=kept)
    first = env.step(kept.clone().set("action", torch.full((5,), -0.5)))["next", "depth"]
    assert not torch.equal(env.reset(kept)["depth"], first)  # a new episode
    assert env._episode == 2


STEP = torch.tensor([[1.0, 0.3, 0.0, -1.0, 0.0], [-1.0, 0.0, 0.0, -0.5, 0.5]])
VECTORS = {
    "SerialEnv": partial(SerialEnv, 2),
    "SerialEnv, without buffers": partial(SerialEnv, 2, use_buffers=False),
    "ParallelEnv, without buffers": partial(
        ParallelEnv, 2, use_buffers=False, mp_start_method="fork"
    ),
    "one process": partial(make_vector, num_envs=2, workers=WorkerOptions(parallel=False)),
    "processes": partial(make_vector, num_envs=2, workers=WorkerOptions(start_method="fork")),
}


@pytest.mark.parametrize("name", VECTORS)
def test_a_vector_restores_the_states_of_its_environments(name):
    make = partial(ba_torchrl.BulletArmEnv, "close_loop/block_picking", obs_size=16)
    vector = VECTORS[name]([partial(make, seed=seed) for seed in (0, 1)])
    try:
        state = vector.reset()
        kept = vector.get_state()
        kept = torch.stack(kept() if callable(kept) else kept) if isinstance(kept, list) else kept
        first = vector.step(state.clone().set("action", STEP))["next"].clone()
        state = vector.reset(kept.clone(), set_state=True)
        second = vector.step(state.set("action", STEP))["next"].clone()
        assert set(first.keys()) == set(second.keys())
        assert all(torch.equal(first[key], second[key]) for key in ("depth", "done", "reward"))
        state = second.exclude("reward").set("_reset", torch.tensor([[True], [False]]))
        state = vector.reset(state.update(kept), set_state=True)
        assert state["step_count"].flatten().tolist() == [0, 1]
        third = vector.step(state.set("action", STEP))["next"]
        assert torch.equal(third["depth"][0], first["depth"][0])
        assert third["step_count"].flatten().tolist() == [1, 2]
    finally:
        vector.close()


@pytest.mark.parametrize(
    "make_vector",
    [
        partial(ParallelEnv, 2, mp_start_method="fork"),
        lambda makers: TransformedEnv(SerialEnv(2, makers), StepCounter(step_count_key="count")),
        VECTORS["one process"],
        lambda makers: TransformedEnv(VECTORS["processes"](makers), RewardSum()),
    ],
    ids=["ParallelEnv", "TransformedEnv", "one process", "TransformedEnv of processes"],
)
def test_a_state_is_a_keyword_where_torchrl_passes_no_entry(make_vector):
    make = partial(ba_torchrl.BulletArmEnv, "close_loop/block_picking", obs_size=16)
    env, vector = make(seed=5), make_vector([partial(make, seed=seed) for seed in (0, 1)])
    try:
        kept = []
        for _ in range(2):
            env.reset()
            kept.append(env.get_state())
        first = [
            env.step(env.reset(each.clone(), set_state=True).set("action", action))["next"]
            for each, action in zip(kept, STEP, strict=True)
        ]
        state = vector.reset(set_state=True, list_of_kwargs=[{"state": each} for each in kept])
        second = vector.step(state.set("action", STEP))["next"]
        assert torch.equal(second["depth"], torch.stack(first)["depth"])
        state = vector.reset(set_state=True, state=kept[0])
        assert torch.equal(state["depth"][0], state["depth"][1])
        inner = vector.base_env if isinstance(vector, TransformedEnv) else vector
        if isinstance(inner, Vector):  # the stack of a vector's get_state
            state = vector.reset(set_state=True, state=torch.stack(kept))
            second = vector.step(state.set("action", STEP))["next"]
            assert torch.equal(second["depth"], torch.stack(first)["depth"])
    finally:
        vector.close()
        env.close()


def test_deleted_states_free_their_memory(make):
    import pybullet

    env = make("close_loop/block_picking", obs_size=32, seed=0)
    env.reset()
    kept = env.get_state()
    number, client = kept["state"].scene.world.id, env.scene.world.client
    del kept
    with pytest.raises(pybullet.error):
        pybullet.restoreState(number, physicsClientId=client)


# -- copies ----------------------------------------------------------------------------------


def assert_independent_and_equal(env, other, state, steps):
    """Step a copy alone, which must not move the original, then the original with its actions."""
    poses = [body.pose for body in env.scene.world.bodies]
    low, high = env.action_spec.space.low, env.action_spec.space.high
    generator = torch.Generator().manual_seed(0)
    taken, there = [], state.clone()
    for number in range(steps):
        action = there["expert_action"].clone()
        if number % 3 == 0:
            action = torch.rand(len(low), generator=generator) * (high - low) + low
        following = other.step(there.set("action", action))["next"]
        taken.append((action, following.clone()))
        there = other.reset() if following["done"] else following
    ends = [body.pose for body in other.scene.world.bodies]
    assert [body.pose for body in env.scene.world.bodies] == poses
    here = state.clone()
    for action, expected in taken:
        following = env.step(here.set("action", action))["next"]
        assert set(following.keys()) == set(expected.keys())
        assert all(torch.equal(following[key], expected[key]) for key in expected.keys())  # noqa: SIM118
        here = env.reset() if following["done"] else following
    assert [body.pose for body in env.scene.world.bodies] == ends
    assert env.conditions == other.conditions


@pytest.mark.parametrize("task", TASKS)
def test_a_copy_is_an_independent_environment_in_the_same_state(make, task):
    env = make(task, obs_size=32, seed=0, expert=True, max_steps=50)
    for before, make_copy in zip((2, 3, 5), COPIES.values(), strict=True):
        state = expert_steps(env, env.reset(), before)
        other = make_copy(env)
        assert other.scene.world.client != env.scene.world.client
        assert_independent_and_equal(env, other, state, 8)
        other.close()


@pytest.mark.parametrize("name", COPIES)
def test_copies_without_a_scene_play_the_same_episodes(make, name):
    env = make("close_loop/block_picking", obs_size=32)  # with a random seed
    other = COPIES[name](env)
    assert torch.equal(env.reset()["depth"], other.reset()["depth"])
    env.step(env.reset().set("action", torch.zeros(5)))
    env.close()
    last = COPIES[name](env)
    other.reset()
    first = env.reset()["depth"]
    for copied in (last, other):
        assert torch.equal(copied.reset()["depth"], first)
        copied.close()


def test_a_copy_after_a_fault_plays_the_next_episode(make):
    env = make("close_loop/block_picking", obs_size=32, seed=0)
    state = env.reset()
    pybullet.disconnect(physicsClientId=env.scene.world.client)
    assert env.step(state.set("action", torch.zeros(5)))["next", "fault"]
    other = copy.deepcopy(env)
    assert torch.equal(other.reset()["depth"], env.reset()["depth"])
    other.close()


def test_a_copy_has_the_parameters_of_the_original(make):
    config = {"obs_size": 32, "robot": "panda", "object_set": "random", "num_objects": 3}
    env = make("close_loop/object_grasping", seed=3, **config)
    env.reset()
    other = copy.deepcopy(env)
    assert other.config == env.config
    assert other.base_seed == 3
    assert not other.run_type_checks
    env.run_type_checks = True
    assert copy.copy(env).run_type_checks
    other.close()


@pytest.mark.parametrize("name", COPIES)
def test_a_copy_of_a_vector_continues_over_the_ends_of_episodes(name):
    options = {"parallel": False, "obs_size": 32, "seed": 0, "max_steps": 3}
    env = ba_torchrl.make_vector_env("close_loop/block_picking", 2, **options)
    state = env.step(env.reset().set("action", torch.zeros(2, 5)))["next"]
    other = COPIES[name](env)
    state["_reset"] = torch.tensor([[True], [False]])
    first, second = (each.reset(state.clone()) for each in (env, other))
    assert torch.equal(first["depth"], second["depth"])
    assert first["step_count"].flatten().tolist() == [0, 1]
    for _ in range(7):
        taken = []
        for each, here in ((env, first), (other, second)):
            here["action"] = torch.full((2, 5), 0.5)
            taken.append(each.step_and_maybe_reset(here))
        (step, first), (step_of_copy, second) = taken
        for key in ("depth", ("next", "depth"), ("next", "done")):
            assert torch.equal(step[key], step_of_copy[key])
        assert torch.equal(first["depth"], second["depth"])
    env.close()
    other.close()
