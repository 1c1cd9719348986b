"""What does not depend on torch's defaults: environments, demonstrations, replay, policies."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.data.augmentation.rigid import RigidAugmentation
from ba_torchrl.data.augmentation.so2 import SO2Augmentation
from ba_torchrl.data.augmentation.views import RandomViews
from ba_torchrl.data.replay.codecs import make_codecs
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.demonstrations.collect import collect_demonstrations, source_config
from ba_torchrl.envs.factory import make
from ba_torchrl.envs.settings import resolve_env
from tests.specs import slow_except

SETTERS = {"dtype": torch.set_default_dtype, "device": torch.set_default_device}
OTHERS = {"dtype": torch.float64, "device": "meta"}
"""Tensors on "meta" hold no values, so that each one made without a device fails."""
CASES = [
    ("close_loop/block_picking", {}),
    ("close_loop/block_picking", {"obs_type": "vec"}),
    ("open_loop/house_building_1", {"rgb": True, "point_cloud": 64}),
    ("open_loop/house_building_1", source_config("deconstruction")),
]
POLICIES = ["close_loop/corner_picking", "open_loop/house_building_1", "ramp/block_stacking"]


@pytest.fixture(params=SETTERS)
def other_default(request):
    """Set another default dtype or device."""
    before = {"dtype": torch.float32, "device": None}
    SETTERS[request.param](OTHERS[request.param])
    yield request.param
    SETTERS[request.param](before[request.param])


def kinds(data):
    return {key: (value.dtype, value.device.type) for key, value in data.items(True, True)}


@pytest.fixture(scope="module")
def expected():
    """Types and devices of the entries of a rollout with torch's defaults."""
    return [kinds(rollout(*case)) for case in CASES]


def rollout(task, config):
    options = {"obs_size": 32, "seed": 0, "expert": True, "max_steps": 3, **config}
    env = options.pop("make", make)(resolve_env(task, options))
    data = env.rollout(4, lambda td: td.set(keys.ACTION, td[keys.EXPERT_ACTION]))
    env.close()
    return data


@pytest.mark.parametrize("number", slow_except(range(len(CASES)), [0, 2]))
def test_environments_fulfil_their_specs(expected, other_default, number):
    task, config = CASES[number]
    assert kinds(rollout(task, config)) == expected[number]
    options = {"obs_size": 32, "seed": 0, "expert": True, "max_steps": 3, **config}
    for env in (
        ba_torchrl.make_vector_env(task, 2, parallel=False, **options),
        options.pop("make", make)(resolve_env(task, options)),
    ):
        check_env_specs(env, break_when_any_done="both", seed=0)
        env.close()


@pytest.fixture(scope="module")
def expected_actions():
    return {task: actions_of_policy(task) for task in POLICIES}


def actions_of_policy(task):
    policy = ba_torchrl.load_policy(task)
    env = policy.make_env(seed=0)
    actions = env.rollout(2, policy)[keys.ACTION]
    env.close()
    return actions


@pytest.mark.parametrize("task", slow_except(POLICIES, POLICIES[-1:]))
def test_policies_are_loaded_and_act(expected_actions, other_default, task):
    assert torch.equal(actions_of_policy(task), expected_actions[task])


def samples(task):
    """Return the declared images of a task, and a batch of each kind of replay by its name."""
    env = ba_torchrl.make_vector_env(
        task, 2, parallel=False, obs_size=32, seed=0, expert=True, max_steps=3
    )
    episodes = collect_demonstrations(env, 3, seed=0, noise=0.3)
    images = ba_torchrl.make(task, obs_size=32).images
    env.close()
    drawn = {}
    for kind in ("uniform", "prioritized", "symmetric"):
        replay = make_replay(kind, 50, 6, codecs=make_codecs(images), seed=0)
        for is_demonstration in (True, False):
            for episode in episodes:
                replay.extend(as_transitions(episode, images, is_demonstration=is_demonstration))
        batch = replay.sample()
        if kind == "prioritized":  # TorchRL's buffer moves the errors to the default device
            errors = batch[keys.NEXT, keys.REWARD].flatten()
            replay.sampler.update_priority(batch["index"], errors, storage=replay.storage)
        drawn[kind] = replay.sample()
    return images, drawn


@pytest.fixture(scope="module")
def expected_samples():
    tasks = ("close_loop/block_picking", "open_loop/house_building_1")
    return {task: samples(task) for task in tasks}


@pytest.mark.parametrize("task", ["close_loop/block_picking", "open_loop/house_building_1"])
def test_the_replay_holds_the_same_transitions(expected_samples, other_default, task):
    _, expected = expected_samples[task]
    _, found = samples(task)
    for kind, batch in expected.items():
        assert kinds(found[kind]) == kinds(batch)
        for key in batch.keys(True, True):
            assert torch.equal(found[kind][key], batch[key]), (kind, key)


def augmented(task, images, batch):
    if task == "open_loop/house_building_1":
        actions = ba_torchrl.make(task, obs_size=32).actions
        return [
            RigidAugmentation(kind, actions, images, seed=0)(batch)
            for kind in ("translation", "se2", "d4")
        ]
    rotation = SO2Augmentation(images, "pxyzr", seed=0)
    views = RandomViews(images, size=24, views=2, seed=0)
    return [rotation(batch), views(batch)]


@pytest.fixture(scope="module")
def expected_augmented(expected_samples):
    return {
        task: augmented(task, images, drawn["uniform"])
        for task, (images, drawn) in expected_samples.items()
    }


@pytest.mark.parametrize("task", ["close_loop/block_picking", "open_loop/house_building_1"])
def test_augmented_transitions_are_the_same(
    expected_samples, expected_augmented, other_default, task
):
    images, drawn = expected_samples[task]
    found_batches = augmented(task, images, drawn["uniform"])
    for found, batch in zip(found_batches, expected_augmented[task], strict=True):
        assert kinds(found) == kinds(batch)
        for key in batch.keys(True, True):
            assert torch.equal(found[key], batch[key]), key
