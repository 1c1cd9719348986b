"""Configurations of environments and runs, and actions: only documented errors, before any work."""

import contextlib
import math

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

import ba_torchrl
from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
from ba_torchrl.core.env_config import EnvConfig
from ba_torchrl.core.errors import ConfigError, InvalidActionError
from ba_torchrl.envs.checks import check_actions, checked_action
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.config import ExperimentConfig
from tests.fuzz.values import JSON, PLUGINS, changed, check, examples

RUN = {
    "task": "close_loop/block_reaching",
    "algorithm": {"name": "sac"},
    "network": {"name": "cnn"},
}
VALUES = st.one_of(
    JSON,
    st.tuples(st.floats(), st.floats()),
    arrays.arrays(np.float32, st.integers(0, 3)),
    st.sampled_from(["pxyz", "pxyzr", "raw", "proj", "vec", "slow", "custom", (0.9, 1.1), 3, 16]),
)


def fields_of(task):
    return EnvConfig.model_fields.keys() | TASKS[task].Parameters.model_fields.keys()


@examples(40)
def test_parameters_of_environments(count):
    def prop(values):
        task, changes = values
        with contextlib.suppress(ConfigError):  # documented
            assert resolve_env(task, changes).config.max_steps >= 1

    tasks = st.sampled_from(list(TASKS))
    each = tasks.flatmap(
        lambda task: st.tuples(st.just(task), changed(fields_of(task), values=VALUES))
    )
    check(count, each, prop)


@pytest.mark.slow
def test_environments_are_made_or_refused():
    def prop(values):
        task, changes = values
        changes = {"obs_size": 16, **changes}
        try:
            env = ba_torchrl.make(task, **changes)
        except ConfigError:
            return
        state = env.reset()
        following = env.step(state.set("action", env.action_spec.rand()))["next"]
        assert not following["fault"]
        env.close()

    small = fields_of("close_loop/block_stacking") - {"render", "rgb", "point_cloud", "obs_size"}
    tasks = st.sampled_from(["close_loop/block_stacking", "open_loop/block_stacking"])
    check(150, st.tuples(tasks, changed(small, values=VALUES)), prop)


def run_values():
    """Configurations of runs with some changes."""
    algorithm = st.sampled_from(list(ALGORITHMS)).flatmap(
        lambda name: changed(ALGORITHMS[name].model_fields).map(lambda v: {"name": name, **v})
    )
    network = st.sampled_from(list(NETWORKS)).flatmap(
        lambda name: changed(NETWORKS[name].model_fields, most=2).map(lambda v: {"name": name, **v})
    )
    others = ExperimentConfig.model_fields.keys() - {"algorithm", "network", "plugins"}
    return st.one_of(
        changed(others).map(lambda v: {**RUN, **v}),
        algorithm.map(lambda v: {**RUN, "algorithm": v}),
        network.map(lambda v: {**RUN, "network": v}),
        PLUGINS.map(lambda v: {**RUN, "plugins": v}),
        changed(EnvConfig.model_fields, values=VALUES).map(lambda v: {**RUN, "env": v}),
        JSON.map(lambda v: {**RUN, "algorithm": v}),
    )


@examples(40)
def test_configurations_of_runs(count):
    def prop(values):
        try:
            config = ExperimentConfig.parse(values)
        except ConfigError:
            pass  # documented
        else:
            assert config.total_updates >= config.pretrain_updates

    check(count, run_values(), prop)


DTYPES = [torch.float32, torch.float64, torch.int64, torch.bool, torch.complex64]
TENSORS = st.tuples(
    st.sampled_from(DTYPES),
    st.lists(st.integers(0, 3), max_size=3),
    st.floats(width=32),
).map(
    lambda value: torch.full(value[1], value[2] if value[0].is_floating_point else 1).to(value[0])
)
ACTIONS = st.one_of(st.none(), TENSORS)


@examples(100)
def test_actions_are_valid_or_refused(count):
    env = ba_torchrl.make("close_loop/block_reaching", obs_size=16)
    vector_spec = torch.stack([env.action_spec] * 2)

    def prop(action):
        try:
            array = checked_action(action, env.task_id, "xyz")
            assert array.shape == (3,)
            assert np.isfinite(array).all()
        except InvalidActionError:
            pass  # documented
        try:
            check_actions(action, vector_spec)
            assert action.shape == vector_spec.shape
            assert torch.isfinite(action).all()
        except InvalidActionError:
            pass  # documented

    check(count, ACTIONS, prop)
    env.close()


@examples(30)
def test_finite_actions_of_any_size_are_executed(count):
    env = ba_torchrl.make("close_loop/block_reaching", obs_size=16, seed=0)
    state = env.reset()

    def prop(action):
        nonlocal state
        following = env.step(state.set("action", torch.tensor(action)))["next"]
        assert not following["fault"]
        assert all(math.isfinite(value.sum()) for value in following.values())
        state = env.reset() if following["done"] else following.exclude("reward")

    finite = st.floats(width=32, allow_nan=False, allow_infinity=False)
    check(count, st.lists(finite, min_size=5, max_size=5), prop)
    env.close()
