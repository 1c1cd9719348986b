"""The algorithm trains on demonstrations, from the keys of a batch that its page lists."""

import torch
from my_algorithm import MyAlgorithmConfig

from ba_torchrl.record.logging import read_scalars
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment

STATE = {"depth", "holding"}
ENDS = {"reward", "done", "terminated", "truncated"}
KEYS = {*STATE, "action", "is_demonstration", "index", *(("next", key) for key in STATE | ENDS)}


def test_training(tmp_path):
    values = {
        "task": "close_loop/block_reaching",
        "env": {"obs_size": 64},
        "algorithm": {"name": "mine/my_algorithm", "batch_size": 16},
        "network": {"name": "cnn", "width": 0.25},
        "run_dir": str(tmp_path / "run"),
    }
    small = {"num_envs": 2, "parallel": False, "demonstrations": 4, "log_every": 1}
    small |= {"total_updates": 40, "eval_every": 40, "eval_episodes": 2, "final_eval_episodes": 2}
    small |= {"video_episodes": 0}
    values["algorithm"]["optimizer"] = {"learning_rate": 3e-3}
    experiment = Experiment(ExperimentConfig.parse({**values, **small}), progress=False)
    experiment.run()
    errors = read_scalars(tmp_path / "run")["train/bc_loss"].values
    assert errors[-10:].mean() < errors[:10].mean()

    learner = experiment.learner
    assert {*learner.sample().keys(True, True)} == KEYS
    updates = learner.updates
    policy = [p.clone() for p in learner.trained_policy.parameters()]
    learner.updates = MyAlgorithmConfig().policy_every * updates + 1
    learner.update()  # of the critics alone
    same = zip(policy, learner.trained_policy.parameters(), strict=True)
    assert all(torch.equal(*each) for each in same)
