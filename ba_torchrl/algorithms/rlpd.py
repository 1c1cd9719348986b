"""Efficient online reinforcement learning with offline data (Ball et al., 2023; "RLPD").

Half of every batch is drawn from the demonstrations; critics are an ensemble with layer
normalisation, with targets from a random subset; and several critic updates are taken for each
update of the policy. There is no term that imitates the demonstrations.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Literal

from pydantic import Field
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LinearLR
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import SoftUpdate

from ba_torchrl.algorithms.base import ALGORITHMS, Control, Problem
from ba_torchrl.algorithms.learner import Learner
from ba_torchrl.algorithms.learner_config import LearnerConfig
from ba_torchrl.algorithms.seeds import SeedUse
from ba_torchrl.config import changed
from ba_torchrl.data.augmentation.so2 import SO2Augmentation
from ba_torchrl.data.transitions import Imitation
from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError
from ba_torchrl.modules.actor_critic.critics import EnsembleCritic
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.base import NETWORKS, ActorCritic, ActorCriticSpec, NetworkConfig
from ba_torchrl.objectives.rlpd import RLPDLoss


@ALGORITHMS.register("rlpd")
class RLPDConfig(LearnerConfig):
    """Hyper-parameters of RLPD.

    Ball et al. (2023) have ten critics, choose a subset of one or two and the entropy backup for
    each environment, and take 20 critic updates per step in environments with vector observations.
    The values that SAC has too are SAC's.
    """

    controls: ClassVar[frozenset[Control]] = frozenset({"close_loop"})
    is_compilable: ClassVar[bool] = False
    """False: the host draws members of the ensemble in each update."""

    replay: Literal["symmetric"] = "symmetric"
    critics: int = Field(default=10, ge=2)
    """Number of critics in the ensemble."""
    subset: int = Field(default=2, ge=1)
    """Number of target critics, drawn in each update, whose minimum is the target."""
    critic_updates: int = Field(default=4, ge=1)
    """Critic updates per update of the policy, each on another batch."""
    entropy_backup: bool = False
    """Whether targets have the entropy term."""
    gamma: float = Field(default=0.99, gt=0, le=1)
    """Discount factor."""
    tau: float = Field(default=0.01, gt=0, le=1)
    """Weight of the critics in the update of their targets."""
    alpha_init: float = Field(default=0.01, gt=0)
    """Initial entropy temperature."""
    target_entropy: float = -5.0
    """Entropy that the temperature is tuned for, nats."""
    augmentation: Literal["so2", "none"] = "none"
    """Rotation of sampled transitions about the z axis."""
    augmentation_probability: float = Field(default=0.8, ge=0, le=1)
    """Probability of rotating a sampled transition."""

    def without_effect(self, network: NetworkConfig) -> Iterator[str]:
        """As for `AlgorithmConfig`: fields of another replay or of the augmentation."""
        yield from super().without_effect(network)
        if self.augmentation == "none":
            yield from changed(self, ["augmentation_probability"], "without augmentation")

    @property
    def imitates(self) -> Imitation:
        """No action, except with ``init="bc"``: all transitions have the same loss."""
        return "expert" if self.init == "bc" else "none"

    @property
    def init_entropy_weight(self) -> float:
        """The initial entropy temperature, so that the cloned policy explores."""
        return self.alpha_init

    def build(self, network: NetworkConfig, problem: Problem) -> RLPD:
        """Return a freshly initialised learner.

        Raises:
            ConfigError: the subset exceeds the ensemble, or the network has no ensemble.
        """
        if self.subset > self.critics:
            raise ConfigError(f"subset: {self.subset} of {self.critics} critics cannot be drawn")
        return RLPD(self, network, problem)


class RLPD(Learner):
    """A squashed Gaussian policy and an ensemble of critics on a shared encoder.

    Args:
        config: hyper-parameters.
        network: builds actor, encoder and ensemble.
        problem: images, actions, device, seed and length of the run.

    Raises:
        ConfigError: the network has no ensemble.
    """

    config: RLPDConfig
    loss: RLPDLoss

    def make_networks(self, network: NetworkConfig) -> ActorCritic:
        """Return actor, encoder and ensemble."""
        sequence = self.problem.actions.sequence
        networks = network.build(ActorCriticSpec(self.images, sequence, self.config.critics))
        if not isinstance(networks.critic, EnsembleCritic):
            name = NETWORKS.name_of(type(network))
            raise ConfigError(f"network {name!r} builds no ensemble of critics; take another one")
        return ActorCritic(*(module.to(self.problem.device) for module in networks))

    def make_policy(self, networks: ActorCritic) -> ProbabilisticActor:
        """Return the squashed Gaussian of the actor."""
        return squashed_gaussian_policy(networks.actor, self.observation_keys)

    def make_loss(self, networks: ActorCritic) -> RLPDLoss:
        """Return the loss of actor, critics and temperature."""
        config = self.config
        loss = RLPDLoss(
            self.make_policy(networks),
            TensorDictModule(networks.encoder, self.observation_keys, ["critic_features"]),
            TensorDictModule(
                networks.critic, ["critic_features", keys.ACTION], ["state_action_value"]
            ),
            subset=config.subset,
            entropy_backup=config.entropy_backup,
            alpha_init=config.alpha_init,
            target_entropy=config.target_entropy,
            seed=self.problem.derived_seed(SeedUse.ENSEMBLE),
        )
        return loss.make_value_estimator(gamma=config.gamma)

    def make_target_updater(self) -> SoftUpdate:
        """Return the soft update of the critics' targets."""
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

    def make_scheduler(self, optimizer: Optimizer) -> LinearLR:
        """Return the schedule of the learning rate, which steps once per critic update."""
        problem = self.problem
        own = self.own_updates(problem.total_updates)
        return LinearLR(
            optimizer,
            start_factor=1.0,
            end_factor=self.config.learning_rate_end_factor,
            total_iters=problem.total_updates + own * (self.config.critic_updates - 1),
        )

    def network_parameters(self) -> list[nn.Parameter]:
        """Return all parameters but the entropy temperature."""
        return [p for p in self.loss.parameters() if p is not self.loss.log_alpha]

    def update(self) -> TensorDict:
        """Take the critic updates, the last one together with that of policy and temperature.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        for _ in range(self.config.critic_updates - 1):
            self.step([self.loss.critic_loss(self.sample())])
        return super().update()

    def state_dict(self) -> dict[str, Any]:
        """Return networks, targets, optimiser, schedule, generators and number of updates."""
        return {**super().state_dict(), "ensemble": self.loss.get_generator_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the learner from a `state_dict` of any device."""
        super().load_state_dict(state)
        self.loss.set_generator_state(state["ensemble"])
