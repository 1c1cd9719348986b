"""A behaviour-cloning algorithm as a user would write it, trained by the experiment loop."""

from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import LossModule

from ba_torchrl.algorithms.base import ALGORITHMS
from ba_torchrl.algorithms.learner import Learner, LearnerConfig
from ba_torchrl.data.augmentation.so2 import SO2Augmentation
from ba_torchrl.envs import keys
from ba_torchrl.modules.base import ActorCriticSpec
from ba_torchrl.record.logging import read_scalars
from ba_torchrl.training.checkpoint import load, problem_of
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment


class BehaviourCloningLoss(LossModule):
    """Mean squared error of the policy's mode to the expert's action."""

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(self, actor_network):
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network")

    def forward(self, tensordict):
        with self.actor_network_params.to_module(self.actor_network):
            mode = self.actor_network.get_dist(tensordict).deterministic_sample
        error = (mode - tensordict[keys.EXPERT_ACTION]).square().mean()
        return TensorDict({"loss_actor": error})


@ALGORITHMS.register("behaviour_cloning")
class BehaviourCloningConfig(LearnerConfig):
    """Regression of the expert's actions, also in states that the policy visits (DAgger)."""

    controls: ClassVar[frozenset[str]] = frozenset({"close_loop"})

    def build(self, network, problem):
        return BehaviourCloning(self, network, problem)


class BehaviourCloning(Learner):
    stores_expert_action = True

    def make_networks(self, network):
        spec = ActorCriticSpec(self.images, self.problem.actions.sequence)
        return network.build(spec).actor

    def make_policy(self, networks):
        return ProbabilisticActor(
            TensorDictModule(networks, self.observation_keys, ["loc", "scale"]),
            in_keys=["loc", "scale"],
            out_keys=[keys.ACTION],
            distribution_class=TanhNormal,
        )

    def make_loss(self, networks):
        return BehaviourCloningLoss(self.make_policy(networks))


# -- tests -------------------------------------------------------------------------------------

RUN = {
    "task": "close_loop/block_reaching",
    "env": {"obs_size": 64, "max_steps": 8},
    "algorithm": {"name": "behaviour_cloning", "batch_size": 16, "learning_rate": 3e-3},
    "network": {"name": "cnn", "width": 0.25, "depth_center_m": 0.2, "depth_scale_m": 0.1},
    "num_envs": 2,
    "parallel": False,
    "demonstrations": 4,
    "total_updates": 40,
    "min_replay": 1,
    "eval_every": 40,
    "eval_episodes": 2,
    "final_eval_episodes": 2,
    "log_every": 1,
    "video_episodes": 0,
}


@pytest.mark.parametrize("pretrain_updates", [0, 40])
def test_a_behaviour_cloning_algorithm_trains(tmp_path, pretrain_updates):
    values = {**RUN, "pretrain_updates": pretrain_updates, "run_dir": str(tmp_path / "run")}
    config = ExperimentConfig.parse(values)
    experiment = Experiment(config, progress=False)
    assert experiment.run().updates == 40
    losses = read_scalars(tmp_path / "run")["train/loss_actor"].values
    assert losses[-10:].mean() < 0.8 * losses[:10].mean()
    stored = experiment.algorithm.replay.storage
    is_expert = stored.column(keys.IS_EXPERT)[:, 0]
    action, expert_action = stored.column(keys.ACTION), stored.column(keys.EXPERT_ACTION)
    assert torch.equal(action[is_expert], expert_action[is_expert])
    assert is_expert.all() == bool(pretrain_updates)
    if not pretrain_updates:  # collected by the policy, labelled by the expert
        assert not torch.equal(action[~is_expert], expert_action[~is_expert])
    _, restored = load(tmp_path / "run")
    for a, b in zip(
        experiment.algorithm.loss.parameters(), restored.loss.parameters(), strict=True
    ):
        assert torch.equal(a, b)


def test_overriding_one_method_replaces_one_part():
    class Augmented(BehaviourCloning):
        def make_augmentation(self):
            return SO2Augmentation(self.images, self.problem.actions.sequence, seed=0)

    config = ExperimentConfig.parse(RUN)
    learner = Augmented(config.algorithm_config, config.network_config, problem_of(config))
    assert isinstance(learner.augmentation, SO2Augmentation)
    assert learner.target_updater is None


def test_pretraining_calls_its_own_update(tmp_path, monkeypatch):
    taken = []

    def pretrain_update(self):
        taken.append(self.updates)
        return self.update()

    monkeypatch.setattr(BehaviourCloning, "pretrain_update", pretrain_update)
    values = {**RUN, "pretrain_updates": 3, "total_updates": 5, "eval_every": 5}
    config = ExperimentConfig.parse({**values, "run_dir": str(tmp_path / "run")})
    assert Experiment(config, progress=False).run().updates == 5
    assert taken == [0, 1, 2]
