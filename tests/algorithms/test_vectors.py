"""Vectors of the observation as inputs of actor-critic networks."""

import dataclasses

import pytest
import torch

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations.collect import collect_demonstrations
from ba_torchrl.demonstrations.demo_files import load_demonstrations, save_demonstrations
from tests.algorithms import tiny

SIZES = {"proprio": 8, "joints": 7}
DRQ = {"views": {"name": "shift", "views": 2, "target_views": 2}}


def build(network="cnn", vectors=tuple(SIZES), algorithm="sac", observed=SIZES, **settings):
    problem = dataclasses.replace(tiny.problem(network), vectors=observed)
    sizes = {"vector_keys": list(vectors)}
    settings = {"batch_size": 6, **settings}
    return tiny.build(algorithm, network, on=problem, sizes=sizes, **settings)


@pytest.mark.parametrize(
    ("network", "vectors", "algorithm", "settings"),
    [
        ("cnn", ("joints", "proprio"), "sac", {}),
        ("cnn", ("proprio",), "sac", DRQ),
        ("cnn", ("proprio",), "rlpd", {}),
        ("cnn", ("proprio",), "iql", {}),
        ("cnn", ("proprio",), "bc", {}),
        ("ferm", ("proprio",), "flow", {}),
        ("equi", ("proprio",), "flow", {}),
        ("ferm", ("proprio", "joints"), "sac", tiny.FERM),
        ("equi", ("proprio",), "sac", {"encoder_tau": 0.5}),
        ("equi", ("proprio",), "rlpd", {}),
    ],
)
def test_updates_and_actions_depend_on_the_vectors(network, vectors, algorithm, settings):
    learner = build(network, vectors, algorithm, **settings)
    data = tiny.transitions(learner)
    learner.extend(data)
    sampled = learner.replay.storage[:]
    for key in vectors:  # stored without loss
        rows = (sampled[key][:, None] == data[key]).all(-1).nonzero()[:, 1]
        assert torch.equal(sampled[keys.NEXT, key], data[keys.NEXT, key][rows])
    learner.update()
    observed = [key for key in learner.policy.in_keys if key != keys.STEP_COUNT]
    assert observed == ["depth", "holding", *vectors]
    state = data[:2].select(*learner.policy.in_keys)
    action = learner.policy(state.clone())[keys.ACTION]
    for key in vectors:
        changed = learner.policy(state.clone().set(key, state[key] + 1))[keys.ACTION]
        assert not torch.allclose(action, changed)


def test_the_contrastive_loss_does_not_compare_vectors():
    learner = build("ferm", ("proprio",), **tiny.FERM)
    learner.extend(tiny.transitions(learner))
    batch = learner.replay.sample()
    loss = learner.loss.contrastive_loss(batch)["loss_contrastive"]
    batch["proprio"] = batch["proprio"] + 5
    assert torch.equal(learner.loss.contrastive_loss(batch)["loss_contrastive"], loss)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ConfigError, match="sees proprio; the environment observes no vectors"):
        build(vectors=("proprio",), observed={})
    for rotation in ("sampled", "stored"):
        with pytest.raises(ConfigError, match="not the network's vectors \\(proprio\\)"):
            build(vectors=("proprio",), rotation={"name": rotation})


def test_a_run_stores_demonstrations_with_vectors_and_its_policy_is_loaded(tmp_path, monkeypatch):
    env = {"obs_size": 64, "max_steps": 6, "observations": ["proprio", "joints", "instruction"]}
    task, folder = "close_loop/block_reaching", tmp_path / "demonstrations"
    envs = ba_torchrl.make_vector_env(task, 2, parallel=False, expert=True, **env)
    episodes = collect_demonstrations(envs, 4, seed=0)
    save_demonstrations(folder, episodes, task=task, env=env, seed=0)
    for saved, episode in zip(
        load_demonstrations(folder, task=task, env=env), episodes, strict=True
    ):
        assert torch.equal(saved["proprio"], episode["proprio"])
        assert list(saved["instruction"]) == ["move the gripper to the red block"] * len(saved)
    monkeypatch.setitem(tiny.SIZES, "cnn", {**tiny.SIZES["cnn"], "vector_keys": list(SIZES)})
    learner = tiny.run(tmp_path, "cnn", {"name": "sac"}, env=env, demonstrations_path=str(folder))
    policy = ba_torchrl.load_policy(tmp_path / "run", which="latest")
    state = envs.reset(seed=1)
    seen = learner.policy(state.clone())[keys.ACTION]
    assert policy(state)[keys.ACTION].shape == seen.shape
    assert policy.in_keys == ["depth", "holding", *SIZES]
    assert policy.env_config["observations"] == tuple(env["observations"])
    envs.close()
