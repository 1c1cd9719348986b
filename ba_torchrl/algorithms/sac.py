"""Soft Actor-Critic and its variants: SACfD, RAD, DrQ, FERM (appendix D.3, F, G.2)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Literal

import torch
from pydantic import Field, model_validator
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torch.optim import Optimizer
from torchrl.data import Bounded
from torchrl.envs import Transform
from torchrl.modules import AdditiveGaussianModule, ProbabilisticActor
from torchrl.objectives import SoftUpdate
from typing_extensions import Self

from ba_torchrl.algorithms.base import (
    ALGORITHMS,
    Control,
    Learner,
    LearnerConfig,
    LossFunction,
    Problem,
    SeedUse,
)
from ba_torchrl.core import keys
from ba_torchrl.core.config import changed
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.data.augmentation.so2 import SO2Augmentation, StoredCopies
from ba_torchrl.data.augmentation.views import (
    CenterCrop,
    RandomViews,
    ViewTransform,
    cropped_images,
)
from ba_torchrl.data.transitions import WITH_TARGET, Imitation
from ba_torchrl.demonstrations.episodes import EpisodeAssembler
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.base import NETWORKS, ActorCritic, NetworkConfig
from ba_torchrl.objectives.imitation import ActionDistance
from ba_torchrl.objectives.sacfd import BilinearInfoNCE, SACfDLoss, SoftUpdateByNetwork


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
    encoder_tau: float | None = Field(default=None, gt=0, le=1)
    """The same for the encoder; None for `tau`."""
    alpha_init: float = Field(default=0.01, gt=0)
    """Initial entropy temperature."""
    target_entropy: float = -5.0
    """Entropy that the temperature is tuned for, nats."""
    entropy_backup: bool = True
    """Whether targets have the entropy term, as in the reference implementation."""
    bootstrap_truncated: bool = True
    """Whether targets bootstrap on steps that the time limit truncates; the reference
    implementation does not."""
    demonstration_weight: float = Field(default=1.0, ge=0)
    """Weight of the behaviour term; 0 for plain SAC; reference implementation."""
    demonstration_distance: ActionDistance = "mse"
    """Distance of the policy's action from the demonstrated one in the behaviour term: the squared
    error of the reference implementation, or "kl", whose gradient does not vanish at the ends of
    the range."""
    imitate_successes: bool = False
    """Whether collected episodes that succeed count as demonstrations (self-imitation; Oh et al.,
    2018): the behaviour term and the expert bonus apply to them, until demonstrations fill half of
    the replay. Transitions then enter the replay when their episode ends. Not in the appendix."""
    exploration_noise: float = Field(default=0.0, ge=0)
    """Standard deviation of Gaussian noise that is added to collected actions, which are then
    clipped to [-1, 1]. None in the appendix."""
    augmentation: Literal["none", "so2"] = "none"
    """Rotation of transitions about the z axis; none in the appendix."""
    augmentation_probability: float = Field(default=0.8, ge=0, le=1)
    """Probability of rotating a sampled transition; not in the appendix."""
    stored_copies: int = Field(default=0, ge=0)
    """Number of rotated copies that are stored with each transition, which is then not rotated when
    it is sampled; 0 to rotate sampled transitions."""
    view_transform: ViewTransform = "none"
    """Random views of sampled images: a "crop", or a "shift" by some pixels. Acting takes the
    centre of the image."""
    crop_size: int = Field(default=128, ge=1)
    """Rows and columns of a crop, pixels."""
    shift_pixels: int = Field(default=4, ge=1)
    """Largest shift, pixels; that of Kostrikov et al. (2021)."""
    views: int = Field(default=1, ge=1)
    """Views of each observation, over which the losses are averaged."""
    target_views: int = Field(default=1, ge=1)
    """Views of each next observation, over which the target is averaged."""
    contrastive_weight: float = Field(default=0.0, ge=0)
    """Factor on the learning rate of the two optimisers of the encoder's contrastive loss on pairs
    of views; 0 for no such loss. Adam's steps do not depend on a factor on the loss. The FERM
    presets have 1, as the reference implementation; the appendix gives no weight."""
    pretraining: Literal["all", "contrastive"] = "all"
    """Losses that updates before the first collection minimise: all, or the contrastive one alone,
    with ``init="bc"`` together with that of behaviour cloning."""

    @model_validator(mode="after")
    def _check_options(self) -> Self:
        needs_views = self.views > 1 or self.target_views > 1 or self.contrastive_weight > 0
        if needs_views and self.view_transform == "none":
            raise ValueError("several views or a contrastive loss need view_transform")
        if self.pretraining == "contrastive" and not self.contrastive_weight:
            raise ValueError("pretraining 'contrastive' needs contrastive_weight")
        if self.stored_copies and self.augmentation == "none":
            raise ValueError("stored_copies needs augmentation")
        return self

    def without_effect(self, network: NetworkConfig) -> Iterator[str]:
        """As for `LearnerConfig`: fields of other augmentations, of a term without weight, and a
        contrastive loss that does not reach the policy."""
        yield from super().without_effect(network)
        if self.augmentation == "none" or self.stored_copies:
            why = "without augmentation='so2' of sampled transitions"
            yield from changed(self, ["augmentation_probability"], why)
        if self.view_transform != "crop":
            yield from changed(self, ["crop_size"], "without view_transform='crop'")
        if self.view_transform != "shift":
            yield from changed(self, ["shift_pixels"], "without view_transform='shift'")
        if not self.demonstration_weight:
            why = "with demonstration_weight=0"
            yield from changed(self, ["demonstration_distance"], why)
            if self.replay == "uniform":
                yield from changed(self, ["imitate_successes"], f"{why} and uniform replay")
        if self.contrastive_weight and getattr(network, "shares_encoder", None) is False:
            name = NETWORKS.name_of(type(network))
            yield f"contrastive_weight has no effect on the encoder of the policy of {name!r}"

    @property
    def imitates(self) -> Imitation:
        """The expert's action, on demonstrations: the behaviour term."""
        return "expert"

    @property
    def init_entropy_weight(self) -> float:
        """The initial entropy temperature, so that the cloned policy explores."""
        return self.alpha_init

    @property
    def pretraining_option(self) -> str | None:
        """As for `LearnerConfig`."""
        if self.pretraining == "contrastive":
            return "pretraining: 'contrastive'"
        return super().pretraining_option

    def build(self, network: NetworkConfig, problem: Problem) -> SAC:
        """Return a freshly initialised learner."""
        return SAC(self, network, problem)


class SAC(Learner):
    """A squashed Gaussian policy and twin critics on a shared encoder.

    Raises:
        ConfigError: an image is smaller than its crop.
    """

    config: SACConfig
    loss: SACfDLoss

    def __init__(self, config: SACConfig, network: NetworkConfig, problem: Problem) -> None:
        self.episodes = EpisodeAssembler() if config.imitate_successes else None
        super().__init__(config, network, problem)

    @property
    def seen_images(self) -> Mapping[str, ImageSpec]:
        """Declarations of the images that the networks see, which are crops if configured."""
        if self.config.view_transform != "crop":
            return self.images
        return cropped_images(self.images, self.config.crop_size)

    def make_networks(self, network: NetworkConfig) -> ActorCritic:
        """Return actor, encoder and critic."""
        networks = network.build(self.network_spec)
        for module in networks:  # before the loss, since networks may share parameters
            module.to(self.problem.device)
        return networks

    def make_policy(self, networks: ActorCritic) -> ProbabilisticActor:
        """Return the squashed Gaussian of the actor."""
        return squashed_gaussian_policy(networks.actor, self.observation_keys)

    def make_acting_transforms(self) -> list[Transform]:
        """Return the images' codecs, and their central part where the networks see crops."""
        transforms = super().make_acting_transforms()
        if self.config.view_transform == "crop":
            transforms.append(CenterCrop(self.config.crop_size, list(self.images)))
        return transforms

    def make_exploration(self) -> AdditiveGaussianModule | None:
        """Return the noise of collected actions, if configured."""
        sigma = self.config.exploration_noise
        if not sigma:
            return None
        actions = Bounded(-1.0, 1.0, (len(self.problem.actions.sequence),))
        return AdditiveGaussianModule(actions, sigma_init=sigma, sigma_end=sigma)

    def make_loss(
        self, networks: ActorCritic, kind: type[SACfDLoss] = SACfDLoss, **options: Any
    ) -> SACfDLoss:
        """Return the loss of actor, critics, temperature and, if configured, encoder.

        Args:
            networks: actor, encoder and critic.
            kind: its class.
            options: that only this class has.
        """
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
            target_entropy=config.target_entropy,
            entropy_backup=config.entropy_backup,
            demonstration_weight=config.demonstration_weight,
            demonstration_distance=config.demonstration_distance,
            weighted_terms=config.importance_weighted,
            weight_norm=config.importance_norm,
            views=config.views,
            target_views=config.target_views,
            contrastive=self._make_contrastive(networks.encoder),
            **options,
        )
        if config.imitates in WITH_TARGET:
            loss.set_keys(target_action=keys.TARGET_ACTION)
        if not config.bootstrap_truncated:
            loss.set_keys(terminated=loss.tensor_keys.done)
        return loss.make_value_estimator(gamma=config.gamma)

    def _make_contrastive(self, encoder: nn.Module) -> BilinearInfoNCE | None:
        if not self.config.contrastive_weight:
            return None
        device = self.problem.device
        shapes = (image.shape for image in self.seen_images.values())
        images = [torch.zeros(shape, device=device) for shape in shapes]
        with torch.no_grad():  # without vectors, which are not compared
            features = encoder(*images, torch.zeros(1, device=device))
        return BilinearInfoNCE(features.shape[-1])

    def make_stages(self) -> list[LossFunction]:
        """Return the loss of actor, critics and temperature and, if configured, then the
        contrastive one."""
        contrastive = [] if self.loss.contrastive is None else [self.loss.contrastive_loss]
        return [self.loss, *contrastive]

    def make_target_updater(self) -> SoftUpdate:
        """Return the soft update of the targets of critic and encoder."""
        config = self.config
        if config.encoder_tau is None:
            return SoftUpdate(self.loss, tau=config.tau)
        taus = {"encoder_network": config.encoder_tau}
        return SoftUpdateByNetwork(self.loss, tau=config.tau, taus=taus)

    @property
    def entries_per_transition(self) -> int:
        """A transition and its rotated copies."""
        return 1 + self.config.stored_copies

    def make_transforms(self) -> list[Transform]:
        """Return the rotation, of stored copies or of sampled transitions, and the views of images,
        if configured."""
        config, parts = self.config, []
        if config.stored_copies:
            rotation = self._make_rotation(1.0, SeedUse.STORED_AUGMENTATION)
            parts.append(StoredCopies(rotation, config.stored_copies))
        elif config.augmentation == "so2":
            probability = config.augmentation_probability
            parts.append(self._make_rotation(probability, SeedUse.AUGMENTATION))
        if config.view_transform != "none":
            is_crop = config.view_transform == "crop"
            parts.append(
                RandomViews(
                    self.images,
                    self.vectors,
                    size=config.crop_size if is_crop else None,
                    padding=0 if is_crop else config.shift_pixels,
                    views=config.views,
                    target_views=config.target_views,
                    has_positive=config.contrastive_weight > 0,
                    seed=self.problem.derived_seed(SeedUse.VIEWS),
                )
            )
        return parts

    def make_optimizer(self) -> Optimizer:
        """Return Adam for all parameters but the contrastive loss's similarity."""
        contrastive = self.loss.contrastive
        if contrastive is None:
            return super().make_optimizer()
        own = set(map(id, contrastive.parameters()))
        return self.adam(p for p in self.loss.parameters() if id(p) not in own)

    def make_term_optimizers(self) -> dict[str, dict[str, Optimizer]]:
        """Return the optimisers of the contrastive loss, if configured: one for the encoder, one
        for encoder and similarity, as in the reference implementation."""
        contrastive = self.loss.contrastive
        if contrastive is None:
            return {}
        encoder = list(self.loss.encoder_network_params.parameters())
        chosen = {"encoder": encoder, "contrastive": [*encoder, *contrastive.parameters()]}
        weight = self.config.contrastive_weight
        return {
            "loss_contrastive": {name: self.adam(each, weight) for name, each in chosen.items()}
        }

    def _make_rotation(self, probability: float, use: SeedUse) -> SO2Augmentation:
        if self.vectors:
            raise ConfigError(
                f"augmentation 'so2' rotates images and actions, but not the network's vectors "
                f"({', '.join(self.vectors)}): use augmentation 'none', or leave out "
                "network.vector_keys"
            )
        return SO2Augmentation(
            self.images,
            self.problem.actions.sequence,
            probability=probability,
            seed=self.problem.derived_seed(use),
        )

    def to_transitions(self, data: TensorDictBase, *, is_demonstration: bool) -> TensorDict:
        """Return collected data as the transitions [N] that the replay stores; if successes are
        imitated, those of the episodes that have ended."""
        if is_demonstration or self.episodes is None:
            return super().to_transitions(data, is_demonstration=is_demonstration)
        data = self.episodes.complete(data.exclude(keys.EXPERT_ACTION))  # imitates what it did
        new = self.entries_per_transition * int(data[keys.IS_EXPERT].sum())
        stored = self.replay.num_demonstrations + new
        if stored > self.config.buffer_size // 2:  # demonstrations are never overwritten
            data[keys.IS_EXPERT] = torch.zeros_like(data[keys.IS_EXPERT])
        return super().to_transitions(data, is_demonstration=True)

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

    def network_parameters(self) -> list[nn.Parameter]:
        """Return all parameters but the entropy temperature."""
        return [p for p in self.loss.parameters() if p is not self.loss.log_alpha]

    def pretrain_update(self) -> TensorDict:
        """Take one update on the demonstrations, as `SACConfig.pretraining` says."""
        if self.config.pretraining == "all":
            return super().pretrain_update()
        batch = self.sample(demonstrations_only=self.init_loss is not None)
        stages = [self.loss.contrastive_loss]
        if self.init_loss is not None:
            stages.insert(0, self.init_loss)
        return self.minimize(batch, stages)
