"""Small collections, and what a list of their batches must be."""

import torch

from ba_torchrl.core import keys
from ba_torchrl.training.collection import start_collection
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.learner import build_learner
from tests.training import test_experiment

SEED = 7
TINY = {
    **test_experiment.TINY,
    "env": {"obs_size": 64, "max_steps": 5},
    "algorithm": {"name": "dagger", "batch_size": 8},
    "num_envs": 4,
    "start_method": "fork",
    "pretrain_updates": 0,
    "total_updates": 12,
    "eval_every": 6,
    "video_episodes": 0,
}


def config_for(tmp_path, collector, **changes):
    values = {**TINY, "collector": collector, "run_dir": str(tmp_path / "run")}
    return ExperimentConfig.parse({**values, **changes})


def start(config):
    """Return the collection of a run, and its learner."""
    learner = build_learner(config)
    return start_collection(config, learner, SEED, None), learner


def change_weights(learner, updates):
    """Set the weights that the policy has after a number of updates; it acts with its means."""
    torch.manual_seed(updates)
    with torch.no_grad():
        for name, parameter in learner.policy.named_parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
            if "log_std" in name:
                parameter.fill_(-1e3 if "bias" in name else 0.0)
    learner.policy.beta.fill_(0.0)
    learner.updates = updates


def own_actions(learner, batch):
    """Return the actions of the learner's policy in the states of a batch."""
    state = batch.select(*learner.policy.in_keys)
    return learner.policy(state)[keys.ACTION]


def assert_each_transition_once(batches):
    """Check that every trajectory consists of all its steps in their order, each once."""
    steps = {}
    for batch in batches:
        for step in batch.unbind(0):
            trajectory = int(step["collector", "traj_ids"]), int(step[keys.ENV_INDEX])
            before = steps.setdefault(trajectory, [])
            assert int(step["step_count"]) == len(before)
            if before:
                assert torch.equal(step[keys.DEPTH], before[-1][keys.NEXT, keys.DEPTH])
                assert not before[-1][keys.NEXT, keys.DONE]
            before.append(step)
    assert len(steps) > 1
    return steps
