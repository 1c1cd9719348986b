"""An algorithm from outside the package, trained by the experiment loop."""

import pytest
import torch

from ba_torchrl.core import keys
from ba_torchrl.data.augmentation.so2 import SO2Augmentation
from ba_torchrl.record.logging import read_scalars
from ba_torchrl.training.checkpoint import load
from ba_torchrl.training.learner import problem_of
from tests.algorithms.tiny import make_experiment

BATCH = {"name": "mine/behaviour_cloning", "batch_size": 16}


@pytest.mark.parametrize("pretrain_updates", [0, pytest.param(40, marks=pytest.mark.slow)])
def test_a_behaviour_cloning_algorithm_trains(tmp_path, pretrain_updates):
    settings = {"pretrain_updates": pretrain_updates, "total_updates": 40, "eval_every": 40}
    settings["env"] = {"obs_size": 64, "max_steps": 8}
    experiment = make_experiment(tmp_path, "cnn", BATCH, **settings)
    assert experiment.run().updates == 40
    losses = read_scalars(tmp_path / "run")["train/loss_actor"].values
    assert losses[-10:].mean() < 0.8 * losses[:10].mean()
    stored = experiment.learner.replay.storage
    is_demonstration = stored.column(keys.IS_DEMONSTRATION)[:, 0]
    action, target = stored.column(keys.ACTION), stored.column(keys.TARGET_ACTION)
    assert torch.equal(action[is_demonstration], target[is_demonstration])
    assert is_demonstration.all() == bool(pretrain_updates)
    if not pretrain_updates:  # collected by the policy, labelled by the expert
        assert not torch.equal(action[~is_demonstration], target[~is_demonstration])
    _, restored = load(tmp_path / "run")
    for a, b in zip(experiment.learner.loss.parameters(), restored.loss.parameters(), strict=True):
        assert torch.equal(a, b)


def test_overriding_one_method_replaces_one_part(additions, tmp_path):
    class Augmented(additions["behaviour_cloning"].BehaviourCloning):
        def make_transforms(self, networks):
            return [SO2Augmentation(self.images, self.problem.actions.sequence, seed=0)]

    config = make_experiment(tmp_path, "cnn", BATCH).config
    learner = Augmented(config.algorithm, config.network, problem_of(config))
    assert isinstance(learner.replay.transform[0], SO2Augmentation)
    assert learner.target_updater is None
