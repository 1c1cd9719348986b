"""What the package returns is copied, pickled and sent to spawned processes, or refuses by name."""

import copy
import pickle
import resource
from contextlib import ExitStack, closing
from functools import cache, partial
from multiprocessing import get_context
from typing import get_args

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import MultiSyncCollector
from torchrl.envs.utils import ExplorationType, set_exploration_type

import ba_torchrl
from ba_torchrl.data import SymmetricSampler
from ba_torchrl.data.replay.make import ReplayKind
from ba_torchrl.demonstrations.collect import RandomActions
from tests.algorithms.tiny import build, transitions
from tests.specs import slow_except

PICKING, STACKING = "close_loop/block_picking", "open_loop/block_stacking"
SMALL = {"obs_size": 32, "seed": 0}


def itself(thing):
    return thing


def act(policy):
    """Return the policy's action in a random observation."""
    torch.manual_seed(0)
    state = TensorDict({key: torch.rand(shape) for key, shape in policy.shapes.items()})
    return policy(state.set("holding", state["holding"] < 0.5))["action"]


def step(env):
    """Return the step after an action of zeros."""
    return env.step(TensorDict({"action": env.action_spec.zero()}, env.batch_size))["next"]


def step_gymnasium(env):
    return env.step(0 * env.action_space.sample())[:4]


def perturb(noise):
    return noise(TensorDict({"action": torch.zeros(4, 5)}, [4]))


def learn(parts):
    """Return the losses of an augmented batch, and the action in its states."""
    policy, loss, transform, batch = parts
    torch.manual_seed(0)
    batch = transform(batch.clone())
    with set_exploration_type(ExplorationType.RANDOM):
        return loss(batch), policy(batch.clone())["action"]


def sample(replay):
    return replay.sample()


def learner(algorithm, network, **settings):
    """Return a learner after an update."""
    learner = build(algorithm, network, batch_size=4, **settings)
    learner.extend(transitions(learner))
    learner.update()
    return learner


def learner_parts(*args, **settings):
    of = learner(*args, **settings)
    return of.policy, of.loss, of.replay.transform, of.replay.storage[:4].clone()


def started(task, **config):
    env = ba_torchrl.make(task, **SMALL, **config)
    env.reset()
    return env


def vector(**options):
    envs = ba_torchrl.make_vector_env(PICKING, 2, **SMALL, **options)
    envs.reset()
    return envs


def gymnasium_env():
    env = gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", **SMALL)
    env.reset()
    return env


def noise():
    with closing(started(PICKING)) as env:
        return RandomActions(env, 0.5, seed=0)


POLICIES = {
    "Equi": PICKING,
    "ASR": "ramp/block_stacking",
    "Equi ASR": STACKING,
}
LEARNERS = {
    "sac cnn": {"rotation": {"name": "sampled"}},
    "sac equi": {"optimizer": {"policy_average": 0.9}},
    "sac ferm": {"views": {"name": "shift"}, "contrastive": {"name": "info_nce"}},
    "rlpd cnn": {},
    "rlpd equi": {},
    "bc equi": {},
    "flow equi": {"rotation": {"name": "sampled"}, "optimizer": {"policy_average": 0.9}},
    "dagger equi_asr": {"rotation": {"name": "se2"}, "beta_init": 0.0},
    "spatial_q asr": {"rotation": {"name": "d4"}, "epsilon_init": 0.5},
    "spatial_q fcn": {},
    "spatial_q rot_fcn": {},
    "spatial_q equi_fcn": {},
    "spatial_q equi_deictic_asr": {},
}
RETURNED = {
    **{
        f"policy, {name}": (partial(ba_torchrl.load_policy, task), act)
        for name, task in POLICIES.items()
    },
    **{
        f"learner, {name}": (partial(learner_parts, *name.split(), **settings), learn)
        for name, settings in LEARNERS.items()
    },
    **{
        f"replay, {kind}": (
            lambda kind=kind: learner("sac", "cnn", replay={"name": kind}).replay,
            sample,
        )
        for kind in get_args(ReplayKind)
    },
    "sampler": (partial(SymmetricSampler, seed=3), SymmetricSampler.state_dict),
    "environment, close loop": (partial(started, PICKING, expert=True), step),
    "environment, open loop": (partial(started, STACKING, rgb=True), step),
    "vector in this process": (partial(vector, parallel=False), step),
    "Gymnasium's environment": (gymnasium_env, step_gymnasium),
    "ResolvedEnv": (partial(ba_torchrl.resolve_env, STACKING, {"num_objects": 2}), itself),
    "noise of demonstrations": (noise, perturb),
}
"""What is returned, and what copies must do like the original."""
QUICK = (
    "policy, Equi",
    "learner, rlpd cnn",
    "learner, flow equi",
    "learner, spatial_q asr",
    "environment, close loop",
    "vector in this process",
    "ResolvedEnv",
    "noise of demonstrations",
)
"""Of `RETURNED`, what holds a generator, a simulator or tensors that share memory."""
NOT_PICKLED = {
    "vector of processes": (
        partial(vector, start_method="fork"),
        "processes of a vector cannot be copied: copy one with parallel=False",
    ),
    "scene": (lambda: started(PICKING).scene, "a world cannot be copied: copy the environment"),
}
NOT_SPAWNED = ("sampler", *(f"replay, {kind}" for kind in get_args(ReplayKind)))
"""Of `RETURNED`, what can be copied and is not given to a spawned process."""


@pytest.fixture(scope="module")
def many_files():
    """Each tensor in shared memory is an open file: allow more of them than the usual 1024."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, 8192)), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.fixture(scope="module")
def returned(many_files):
    """Return a function that makes an entry of `RETURNED` or `NOT_PICKLED`, once."""
    with ExitStack() as stack:

        @cache
        def make(name):
            thing = {**RETURNED, **NOT_PICKLED}[name][0]()
            if hasattr(thing, "close"):
                stack.enter_context(closing(thing))
            return thing

        yield make


def assert_same(found, expected):
    if isinstance(expected, TensorDictBase):
        found, expected = found.to_dict(), expected.to_dict()
    elif isinstance(expected, tuple):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            assert_same(*pair)
    if isinstance(expected, dict | list | torch.Tensor | np.ndarray):
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
    elif not isinstance(expected, tuple):
        assert found == expected


SLOW = [f"learner, spatial_q {name}" for name in ("fcn", "rot_fcn", "equi_fcn")]
SLOW += [
    "learner, sac ferm",
    "learner, rlpd equi",
    "learner, bc equi",
    "learner, spatial_q equi_deictic_asr",
    "policy, ASR",
    "policy, Equi ASR",
]


@pytest.mark.parametrize("name", slow_except(RETURNED, {*RETURNED} - {*SLOW}))
def test_a_copy_behaves_like_the_original(name, returned):
    thing, use = returned(name), RETURNED[name][1]
    others = [copy.deepcopy(thing), pickle.loads(pickle.dumps(thing))]
    expected = use(thing)
    for other in others:
        assert_same(use(other), expected)
        if hasattr(other, "close"):
            other.close()


def use_all(things, connection):
    """Send what is done with each of ``things``, by name."""
    results = {name: RETURNED[name][1](thing) for name, thing in things.items()}
    # not `send`: a process that ends takes its shared memory along
    connection.send_bytes(pickle.dumps(results))


@pytest.mark.parametrize(
    "names", [QUICK, pytest.param(RETURNED, marks=pytest.mark.slow)], ids=["quick", "all"]
)
def test_a_spawned_process_receives_them(names, returned):
    things = {name: returned(name) for name in names if name not in NOT_SPAWNED}
    receiver, sender = get_context("spawn").Pipe(duplex=False)
    process = get_context("spawn").Process(target=use_all, args=(things, sender))
    process.start()
    try:
        sender.close()
        assert receiver.poll(240)
        found = pickle.loads(receiver.recv_bytes())
    finally:
        process.kill()
        process.join()
    for name, thing in things.items():
        assert_same(found[name], RETURNED[name][1](thing))


def spawn(thing):
    get_context("spawn").Process(target=print, args=(thing,)).start()


@pytest.mark.parametrize(
    ("send", "name", "message"),
    [
        *((pickle.dumps, name, text) for name, (_, text) in NOT_PICKLED.items()),
        *((spawn, name, text) for name, (_, text) in NOT_PICKLED.items()),
        *(
            (spawn, name, "between processes: collect without replay_buffer")
            for name in NOT_SPAWNED
        ),
    ],
)
def test_what_cannot_be_sent_says_so(send, name, message, returned):
    with pytest.raises((TypeError, RuntimeError), match=message):
        send(returned(name))


@pytest.mark.slow
def test_a_trained_policy_collects_in_spawned_processes():
    policy = ba_torchrl.load_policy(PICKING)
    collector = MultiSyncCollector(
        [policy.make_env] * 2, policy=policy, frames_per_batch=10, total_frames=10
    )
    try:
        (batch,) = collector
    finally:
        collector.shutdown()
    expected = policy(batch.select(*policy.in_keys))["action"]
    torch.testing.assert_close(batch["action"], expected)
