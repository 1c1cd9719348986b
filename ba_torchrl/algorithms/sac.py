"""Soft Actor-Critic, with or without demonstrations (SAC and SACfD; appendix D.3, G.2)."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate

from ba_torchrl.algorithms.base import ALGORITHMS, Control, Problem
from ba_torchrl.algorithms.learner import Learner, LearnerConfig
from ba_torchrl.algorithms.seeds import SeedUse
from ba_torchrl.data.augmentation.so2 import SO2Augmentation
from ba_torchrl.envs import keys
from ba_torchrl.modules.base import ActorCritic, ActorCriticSpec, NetworkConfig
from ba_torchrl.objectives.sacfd import SACfDLoss


@ALGORITHMS.register("sac")
class SACConfig(LearnerConfig):
    """Hyper-parameters of SAC and its variants, which are presets in ``configs/algorithm``.

    The defaults are those of SACfD in appendix G.2. Where the appendix gives no value, the default
    is that of the reference implementation, and the field says so.
    """

    controls: ClassVar[frozenset[Control]] = frozenset({"close_loop"})

    gamma: float = Field(default=0.99, gt=0, le=1)
    """Discount factor."""
    tau: float = Field(default=0.01, gt=0, le=1)
    """Weight of the critic in the update of its target; reference implementation."""
    alpha_init: float = Field(default=0.01, gt=0)
    """Initial entropy temperature."""
    target_entropy: float = -5.0
    """Entropy that the temperature is tuned for, nats."""
    demonstration_weight: float = Field(default=1.0, ge=0)
    """Weight of the behaviour term; 0 for plain SAC; reference implementation."""
    augmentation: Literal["none", "so2"] = "none"
    """Rotation of transitions about the z axis; none in the appendix."""
    augmentation_probability: float = Field(default=0.8, ge=0, le=1)
    """Probability of rotating a sampled transition."""

    def build(self, network: NetworkConfig, problem: Problem) -> SAC:
        """Return a freshly initialised learner."""
        return SAC(self, network, problem)


class SAC(Learner):
    """A squashed Gaussian policy and twin critics on a shared encoder.

    Args:
        config: hyper-parameters.
        network: builds actor, encoder and critic.
        problem: images, actions, device, seed and length of the run.
    """

    config: SACConfig
    loss: SACfDLoss

    def make_networks(self, network: NetworkConfig) -> ActorCritic:
        """Return actor, encoder and critic."""
        return network.build(ActorCriticSpec(self.images, self.problem.actions.sequence))

    def make_policy(self, networks: ActorCritic) -> ProbabilisticActor:
        """Return the squashed Gaussian of the actor."""
        module = TensorDictModule(
            networks.actor, in_keys=self.observation_keys, out_keys=["loc", "scale"]
        )
        return ProbabilisticActor(
            module,
            in_keys=["loc", "scale"],
            out_keys=[keys.ACTION],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": -1.0, "high": 1.0},
        )

    def make_loss(self, networks: ActorCritic) -> SACfDLoss:
        """Return the loss of actor, critics and temperature."""
        config = self.config
        loss = SACfDLoss(
            self.make_policy(networks),
            TensorDictModule(
                networks.encoder, in_keys=self.observation_keys, out_keys=["critic_features"]
            ),
            TensorDictModule(
                networks.critic,
                in_keys=["critic_features", keys.ACTION],
                out_keys=["state_action_value"],
            ),
            alpha_init=config.alpha_init,
            target_entropy=config.target_entropy,
            demonstration_weight=config.demonstration_weight,
            weighted_terms=config.importance_weighted,
            weight_norm=config.importance_norm,
        )
        return loss.make_value_estimator(gamma=config.gamma)

    def make_target_updater(self) -> SoftUpdate:
        """Return the soft update of the critic's target."""
        return SoftUpdate(self.loss, tau=self.config.tau)

    def make_augmentation(self) -> nn.Module:
        """Return the rotation of sampled transitions, if it is configured."""
        if self.config.augmentation == "none":
            return nn.Identity()
        return SO2Augmentation(
            self.images,
            self.problem.actions.sequence,
            probability=self.config.augmentation_probability,
            seed=self.problem.derived_seed(SeedUse.AUGMENTATION),
        )

    def network_parameters(self) -> list[nn.Parameter]:
        """Return all parameters but the entropy temperature."""
        return [p for p in self.loss.parameters() if p is not self.loss.log_alpha]
