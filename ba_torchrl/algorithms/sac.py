"""Soft Actor-Critic and its variants: SACfD, RAD, DrQ, FERM (appendix D.3, F, G.2)."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torch.optim import Optimizer
from torchrl.data import Bounded
from torchrl.envs import Transform
from torchrl.modules import AdditiveGaussianModule, ProbabilisticActor
from torchrl.objectives import SoftUpdate

from ba_torchrl.algorithms.base import Learner, LossFunction, Problem, SeedUse
from ba_torchrl.algorithms.sac_config import SACConfig
from ba_torchrl.core import keys
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.data.transitions import WITH_TARGET
from ba_torchrl.demonstrations.episodes import is_success
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.base import ActorCritic
from ba_torchrl.modules.config import NETWORKS, NetworkConfig
from ba_torchrl.objectives.sacfd import SACfDLoss, SoftUpdateByNetwork

logger = logging.getLogger(__name__)


class SAC(Learner):
    """A squashed Gaussian policy and twin critics on a shared encoder."""

    config: SACConfig
    loss: SACfDLoss

    def __init__(self, config: SACConfig, network: NetworkConfig, problem: Problem) -> None:
        super().__init__(config, network, problem)
        self.episodes = config.imitation.build()

    @property
    def seen_images(self) -> Mapping[str, ImageSpec]:
        """Declarations of the images that the networks see, which are crops if configured."""
        return self.config.views.seen(self.images)

    def make_networks(self, network: NetworkConfig) -> ActorCritic:
        """Return actor, encoder and critic."""
        if self.config.contrastive.name != "none" and not network.shares_encoder:
            name = NETWORKS.name_of(type(network))
            logger.warning("contrastive has no effect on the encoder of the policy of %r", name)
        networks = network.build(self.network_spec)
        for module in networks:  # before the loss, since networks may share parameters
            module.to(self.problem.device)
        return networks

    def make_policy(self, networks: ActorCritic) -> ProbabilisticActor:
        """Return the squashed Gaussian of the actor."""
        return squashed_gaussian_policy(networks.actor, self.observation_keys)

    def make_acting_transforms(self) -> list[Transform]:
        """Return the images' codecs, and their central part where the networks see crops."""
        return [*super().make_acting_transforms(), *self.config.views.acting(self.images)]

    def make_exploration(self) -> AdditiveGaussianModule | None:
        """Return the noise of collected actions, if configured."""
        sigma = self.config.exploration_noise
        if not sigma:
            return None
        actions = Bounded(-1.0, 1.0, (len(self.problem.actions.sequence),))
        return AdditiveGaussianModule(actions, sigma_init=sigma, sigma_end=sigma)

    @property
    def _target_entropy(self) -> float:
        """The configured entropy, nats."""
        entropy = self.config.target_entropy
        return -float(self.problem.actions.size) if entropy == "auto" else entropy

    def make_loss(
        self, networks: ActorCritic, kind: type[SACfDLoss] = SACfDLoss, **options: Any
    ) -> SACfDLoss:
        """Return the loss of actor, critics, temperature and, if configured, encoder."""
        config = self.config
        loss = kind(
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
            target_entropy=self._target_entropy,
            entropy_backup=config.entropy_backup,
            **config.imitation.loss_options,
            **config.replay.loss_options,
            **config.views.loss_options,
            contrastive=config.contrastive.build(networks.encoder, self.seen_images),
            **options,
        )
        if config.imitates in WITH_TARGET:
            loss.set_keys(target_action=keys.TARGET_ACTION)
        if not config.bootstrap_truncated:
            loss.set_keys(terminated=loss.tensor_keys.done)
        return loss.make_value_estimator(gamma=config.gamma)

    def make_stages(self, loss: SACfDLoss) -> list[LossFunction]:
        """Return the loss of actor, critics and temperature and, if configured, then the
        contrastive one."""
        return [loss] if loss.contrastive is None else [loss, loss.contrastive_loss]

    def make_first_losses(
        self, policy: ProbabilisticActor, loss: SACfDLoss
    ) -> list[tuple[int, LossFunction]]:
        """Return the loss of the initialisation, and the contrastive one."""
        config = self.config
        contrastive = (config.contrastive.updates, loss.contrastive_loss)
        return [*config.init.build(policy), contrastive]

    def make_target_updater(self, loss: SACfDLoss) -> SoftUpdate:
        """Return the soft update of the targets of critic and encoder."""
        config = self.config
        if config.encoder_tau is None:
            return SoftUpdate(loss, tau=config.tau)
        taus = {"encoder_network": config.encoder_tau}
        return SoftUpdateByNetwork(loss, tau=config.tau, taus=taus)

    @property
    def entries_per_transition(self) -> int:
        """A transition and its rotated copies."""
        return 1 + self.config.rotation.copies

    def make_transforms(self, networks: ActorCritic) -> list[Transform]:
        """Return the rotation, of stored copies or of sampled transitions, and the views of images,
        if configured."""
        config = self.config
        rotation = config.rotation.build(self.problem, self.images, self.vectors)
        views = config.views.build(
            self.images,
            self.vectors,
            seed=self.problem.derived_seed(SeedUse.VIEWS),
            has_positive=config.contrastive.name != "none",
        )
        return rotation + views

    def make_optimizer(self, loss: SACfDLoss) -> Optimizer:
        """Return Adam for all parameters but the contrastive loss's similarity."""
        if loss.contrastive is None:
            return super().make_optimizer(loss)
        own = set(map(id, loss.contrastive.parameters()))
        return self.adam((p for p in loss.parameters() if id(p) not in own), loss)

    def make_term_optimizers(self, loss: SACfDLoss) -> dict[str, dict[str, Optimizer]]:
        """Return the optimisers of the contrastive loss, if configured: one for the encoder, one
        for encoder and similarity, as in the reference implementation."""
        if loss.contrastive is None:
            return {}
        encoder = list(loss.encoder_network_params.parameters())
        chosen = {"encoder": encoder, "contrastive": [*encoder, *loss.contrastive.parameters()]}
        weight = self.config.contrastive.weight
        optimizers = {name: self.adam(each, loss, weight) for name, each in chosen.items()}
        return {"loss_contrastive": optimizers}

    def on_collected(self, data: TensorDictBase) -> None:
        """Store collected steps; if successes are imitated, the episodes that have ended, of which
        those that succeed count as demonstrations."""
        if self.episodes is None:
            super().on_collected(data)
            return
        ended = self.episodes.complete(data.exclude(keys.EXPERT_ACTION))  # imitates what it did
        left = self.config.replay.capacity // 2 - self.replay.num_demonstrations
        stored = []
        for episode in ended:
            new = self.entries_per_transition * len(episode)
            imitates = is_success(episode) and new <= left  # demonstrations are never overwritten
            left -= new * imitates
            stored.append(self.to_transitions(episode, is_demonstration=imitates))
        if stored:
            self.extend(torch.cat(stored))

    def replay_state(self) -> dict[str, Any]:
        """Return the state of the replay and, if successes are imitated, the transitions of
        unfinished episodes."""
        if self.episodes is None:
            return super().replay_state()
        return {**super().replay_state(), "episodes": self.episodes.state_dict()}

    def load_replay_state(self, state: dict[str, Any]) -> None:
        """Restore the replay, and the unfinished episodes, from a `replay_state`."""
        super().load_replay_state(state)
        if self.episodes is not None:
            self.episodes.load_state_dict(state["episodes"])

    def network_parameters(self, loss: SACfDLoss) -> list[nn.Parameter]:
        """Return all parameters but the entropy temperature."""
        return [p for p in loss.parameters() if p is not loss.log_alpha]
