"""Soft Actor-Critic, with or without demonstrations (SAC and SACfD; appendix D.3, G.2)."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate

from ba_torchrl.algorithms.base import ALGORITHMS, Problem
from ba_torchrl.algorithms.learner import Learner, LearnerConfig
from ba_torchrl.data.augmentation.so2 import SO2Augmentation
from ba_torchrl.data.replay.buffer import make_replay_buffer
from ba_torchrl.data.replay.codecs import DepthQuantizer
from ba_torchrl.envs import keys
from ba_torchrl.modules.base import ActorCriticSpec, NetworkConfig
from ba_torchrl.objectives.sacfd import SACfDLoss


@ALGORITHMS.register("sac")
class SACConfig(LearnerConfig):
    """Hyper-parameters of the SAC family; the presets in ``configs/algorithm`` name its members.

    The defaults are the paper's (appendix G.2).
    """

    control: ClassVar[Literal["open_loop", "close_loop"]] = "close_loop"

    learning_rate: float = Field(default=1e-3, gt=0)
    gamma: float = Field(default=0.99, gt=0, le=1)
    batch_size: int = Field(default=64, ge=1)
    augmentation_probability: float = Field(default=0.8, ge=0, le=1)
    tau: float = Field(default=0.01, gt=0, le=1)
    """Share of the critic that enters its target at every update."""
    alpha_init: float = Field(default=0.01, gt=0)
    """First value of the entropy temperature."""
    target_entropy: float = -5.0
    """Entropy that the temperature is tuned for."""
    demonstration_weight: float = Field(default=1.0, ge=0)
    """Factor of the behaviour term; 0 is plain SAC."""
    prioritized: bool = True
    """Draw transitions by their TD error instead of uniformly."""
    augmentation: Literal["so2", "none"] = "so2"
    """Rotate sampled transitions about the vertical."""

    def build(self, network: NetworkConfig, problem: Problem) -> SAC:
        """Return a freshly initialised learner."""
        return SAC(self, network, problem)


class SAC(Learner):
    """A squashed-Gaussian policy, twin critics on a shared encoder and a prioritised replay.

    Args:
        config: hyper-parameters.
        network: builds actor, encoder and critic.
        problem: shapes, device, seed and length of the run.
    """

    def __init__(self, config: SACConfig, network: NetworkConfig, problem: Problem) -> None:
        nets = network.build(ActorCriticSpec(problem.image_size, problem.actions.sequence))
        observation = [keys.PIXELS, keys.HOLDING]
        self.quantizer = DepthQuantizer(problem.max_depth_m)
        policy = _tanh_policy(_Acting(nets.actor, self.quantizer)).select_out_keys(keys.ACTION)
        loss = SACfDLoss(
            _tanh_policy(nets.actor),
            TensorDictModule(nets.encoder, in_keys=observation, out_keys=["critic_features"]),
            TensorDictModule(
                nets.critic,
                in_keys=["critic_features", keys.ACTION],
                out_keys=["state_action_value"],
            ),
            alpha_init=config.alpha_init,
            target_entropy=config.target_entropy,
            demonstration_weight=config.demonstration_weight,
        ).to(problem.device)
        loss.make_value_estimator(gamma=config.gamma)
        super().__init__(
            config,
            problem,
            policy=policy.to(problem.device),
            loss=loss,
            target_updater=SoftUpdate(loss, tau=config.tau),
            replay=make_replay_buffer(
                config.buffer_size,
                config.batch_size,
                codecs={keys.PIXELS: self.quantizer},
                prioritized=config.prioritized,
                priority_exponent=config.priority_exponent,
                weight_exponent=config.importance_exponent,
                expert_bonus=config.expert_bonus,
                seed=problem.seed,
            ),
            augmentation=(
                SO2Augmentation(
                    problem.actions.sequence,
                    probability=config.augmentation_probability,
                    seed=problem.seed,
                )
                if config.augmentation == "so2"
                else nn.Identity()
            ),
        )


class _Acting(nn.Module):
    """An actor that sees depth as the replay stores it."""

    def __init__(self, actor: nn.Module, quantizer: nn.Module) -> None:
        super().__init__()
        self.actor = actor
        self.quantizer = quantizer

    def forward(self, pixels: Tensor, holding: Tensor) -> tuple[Tensor, Tensor]:
        return self.actor(self.quantizer(pixels), holding)


def _tanh_policy(actor: nn.Module) -> ProbabilisticActor:
    module = TensorDictModule(actor, in_keys=[keys.PIXELS, keys.HOLDING], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module,
        in_keys=["loc", "scale"],
        out_keys=[keys.ACTION],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
    )
