"""The algorithm of action chunks, and its policy in everything that plays episodes."""

from contextlib import closing

import pytest
import torch

import ba_torchrl
from ba_torchrl.commands import evaluate, export, play
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.testing.diagnosis import diagnose
from ba_torchrl.training import protocol
from ba_torchrl.training.evaluation import record_episodes
from ba_torchrl.training.policy import round_weights, save_policy
from tests.algorithms.tiny import build, make_experiment, transitions

FLOW = {"name": "flow", "executed": 2, "optimizer": {"policy_average": 0.5}}


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    """A finished run."""
    experiment = make_experiment(tmp_path_factory.mktemp("flow"), "equi", FLOW)
    experiment.run()
    return experiment


def actions(policy, num_envs):
    """The actions of three episodes of the protocol, by their seeds' order."""
    found = {}
    env_config = {**policy.env_config, "parallel": False}
    with closing(ba_torchrl.make_vector_env(policy.task, num_envs, **env_config)) as env:
        test = protocol.run_test(
            env, policy, 0, 3, lambda each: found.update({each[0]["action"][1].item(): each})
        )
    return test.lengths, [found[first][keys.ACTION] for first in sorted(found)]


def test_outcomes_do_not_depend_on_the_number_of_environments(experiment):
    policy = ba_torchrl.load_policy(experiment.config.folder, which="latest")
    lengths, expected = actions(policy, 1)
    assert len(expected) == 3
    assert not torch.equal(expected[0], expected[1])
    for num_envs in (3, 8):
        assert actions(policy, num_envs)[0] == lengths
        assert all(map(torch.equal, actions(policy, num_envs)[1], expected))


def inner(policy):
    """How many actions a policy executes, in how many steps it draws them."""
    chunks = policy.policy.policy
    return chunks.executed, chunks.flow.module.steps


def test_a_trained_policy_acts_by_other_values(experiment, tmp_path, capsys):
    run, file = experiment.config.run_dir, tmp_path / "chunks.safetensors"
    common = ["num_envs=1", "parallel=false", "episodes=1"]
    export.COMMAND.run([run, f"path={file}", "which=latest", "algorithm.executed=1", *common])
    trained = ba_torchrl.load_policy(run, which="latest")
    changed = ba_torchrl.load_policy(run, which="latest", acting={"executed": 1, "steps": 3})
    assert inner(trained) == (2, 8)
    assert inner(changed) == (1, 3)
    assert inner(ba_torchrl.load_policy(file)) == (1, 8)
    assert changed.config.algorithm.executed == 1
    capsys.readouterr()
    evaluate.COMMAND.run([str(file), "algorithm.steps=3", *common])
    assert f"{file}, algorithm.steps=3" in capsys.readouterr().out
    with pytest.raises(ConfigError, match=r"algorithm.draws cannot .*: executed, steps"):
        ba_torchrl.load_policy(run, acting={"draws": 3})
    with pytest.raises(ConfigError, match=r"executed \(5\) must be at most horizon"):
        ba_torchrl.load_policy(file, acting={"executed": 5})
    with pytest.raises(ConfigError, match=r"policy of dagger; .* acts by: none"):
        ba_torchrl.load_policy("close_loop/block_reaching", acting={"executed": 1})


@pytest.mark.parametrize("command", [evaluate, play])
def test_only_policies_of_this_package_act_by_fields_of_an_algorithm(command, capsys):
    with pytest.raises(SystemExit):
        command.COMMAND.run(["policy=lerobot:nothing", "algorithm.executed=1"])
    assert "algorithm is of" in capsys.readouterr().err


def test_the_policy_is_exported_loaded_filmed_and_diagnosed(experiment, tmp_path):
    policy = ba_torchrl.load_policy(experiment.config.folder, which="latest")
    assert policy.out_keys == [keys.ACTION, (keys.CARRIED, keys.ACTION_CHUNK)]
    round_weights(policy)
    file, options = tmp_path / "chunks.safetensors", {"parallel": False, **policy.env_config}
    with closing(ba_torchrl.make_vector_env(policy.task, 1, **options)) as env:
        save_policy(policy, file, protocol.run_test(env, policy, 2, 1))
    loaded, played = ba_torchrl.load_policy(file), []
    with closing(loaded.make_env(expert=True)) as env:
        for each in (policy, loaded):
            env.set_seed(3)
            played.append(env.rollout(6, each)[keys.ACTION])
        assert diagnose(env, loaded, [5]).episodes == 1
    assert torch.equal(*played)
    assert len(record_episodes(policy.config.env, loaded, 1, seed=0)) > 6


def test_a_chunk_is_executed_in_part(experiment):
    policy = ba_torchrl.load_policy(experiment.config.folder, which="latest")
    with closing(policy.make_env(seed=0)) as env:
        rollout = env.rollout(6, policy)
    chunks = rollout[keys.CARRIED, keys.ACTION_CHUNK]
    assert torch.equal(rollout[keys.ACTION], chunks[:, 0])
    for step in range(1, len(rollout)):
        is_same = torch.equal(chunks[step, :-1], chunks[step - 1, 1:])
        assert is_same == (step % 2 == 1)  # two of four are executed


@pytest.mark.slow
def test_the_policy_is_exported_by_torch(experiment):
    policy = ba_torchrl.load_policy(experiment.config.folder, which="latest")
    with closing(policy.make_env(seed=0)) as env:
        seen = env.reset().select(*policy.in_keys)

    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.policy = policy

        def forward(self, chunk, *entries):
            state = dict(zip(policy.in_keys, entries, strict=True))
            state = seen.select(*policy.in_keys).update(state)
            return self.policy(state.set((keys.CARRIED, keys.ACTION_CHUNK), chunk))["action"]

    entries = tuple(seen[key] for key in policy.in_keys)
    chunk = torch.rand(4, 5)
    exported = torch.export.export(Net(), (chunk, *entries), strict=True).module()
    torch.testing.assert_close(exported(chunk, *entries), policy(seen.clone())["action"])
    later = (*entries[:-1], entries[-1] + 1)  # in the middle of a chunk
    torch.testing.assert_close(exported(chunk, *later), chunk[1])


def test_the_chunks_of_noisy_demonstrations_end_where_the_expert_did_not_act():
    learner = build("flow", "cnn", horizon=3, executed=1)
    data = transitions(learner, 5).exclude(keys.TARGET_ACTION, keys.TARGET_CHUNK)
    data[keys.NEXT, keys.FAULT] = torch.zeros(5, 1, dtype=torch.bool)
    data[keys.EXPERT_ACTION] = -data[keys.ACTION] / 2
    data[keys.IS_EXPERT] = torch.tensor([1, 0, 1, 1, 1]).bool()[:, None]
    learner.on_demonstrations([data])
    stored = learner.replay.storage[:]
    label = data[keys.EXPERT_ACTION]
    assert torch.equal(stored[keys.TARGET_CHUNK][0], label[:3])
    mask = stored[keys.TARGET_CHUNK_MASK].int().tolist()
    assert mask == [[1, 1, 0], [1, 0, 0], [1, 1, 1], [1, 1, 0], [1, 0, 0]]
    # without the expert's action in every state, its steps alone are stored
    other = build("flow", "cnn", horizon=3, executed=1)
    other.on_demonstrations([data.exclude(keys.EXPERT_ACTION)])
    stored = other.replay.storage[:]
    assert torch.equal(stored[keys.TARGET_CHUNK][:, 0], data[keys.ACTION][[0, 2, 3, 4]])
    mask = stored[keys.TARGET_CHUNK_MASK].int().tolist()
    assert mask == [[1, 0, 0], [1, 1, 1], [1, 1, 0], [1, 0, 0]]


def test_chunks_turn_with_the_sampled_images():
    learner = build("flow", "cnn", rotation={"name": "sampled", "probability": 1.0}, batch_size=8)
    data = transitions(learner)
    learner.extend(data)
    sampled = learner.sample()
    before = data[keys.TARGET_CHUNK]
    for chunk, index in zip(sampled[keys.TARGET_CHUNK], sampled["index"], strict=True):
        others = [0, 3, 4]
        assert torch.equal(chunk[:, others], before[index][:, others])
        assert not torch.allclose(chunk[:, 1:3], before[index][:, 1:3])


def test_the_expert_plays_a_chunk_in_the_states_that_the_policy_visits(tmp_path):
    settings = {"name": "flow_dagger", "horizon": 3}
    learner = make_experiment(tmp_path, "cnn", settings, demonstrations_noise=0.3)
    learner.run()
    stored = learner.learner.replay.storage[:]
    is_visited = ~stored[keys.IS_DEMONSTRATION].squeeze(-1)
    assert is_visited.sum() >= 4
    assert torch.equal(stored[keys.TARGET_CHUNK][:, 0], stored[keys.TARGET_ACTION])
    assert stored[keys.TARGET_CHUNK_MASK][:, 0].all()
    assert stored[keys.TARGET_CHUNK_MASK][is_visited].all()  # far from the goal
    assert not torch.equal(stored[keys.ACTION][is_visited], stored[keys.TARGET_ACTION][is_visited])
