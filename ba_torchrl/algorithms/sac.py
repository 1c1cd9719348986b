"""Soft Actor-Critic, with or without demonstrations (SAC and SACfD; appendix D.3, G.2)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate

from ba_torchrl.algorithms.base import ALGORITHMS, Algorithm, AlgorithmConfig, Problem
from ba_torchrl.data.augmentation import SO2Augmentation
from ba_torchrl.data.quantization import DepthQuantizer
from ba_torchrl.data.replay import make_replay_buffer
from ba_torchrl.envs import keys
from ba_torchrl.modules.base import ActorCriticSpec, NetworkConfig
from ba_torchrl.objectives.sacfd import SACfDLoss


@ALGORITHMS.register("sac")
class SACConfig(AlgorithmConfig):
    """Hyper-parameters of the SAC family; the presets in ``configs/algorithm`` name its members.

    The defaults are the paper's (appendix G.2).
    """

    control: ClassVar[Literal["open_loop", "close_loop"]] = "close_loop"

    learning_rate: float = Field(default=1e-3, gt=0)
    """Adam's, for actor, critic and temperature."""
    learning_rate_end_factor: float = Field(default=1.0, gt=0, le=1)
    """Share of the learning rate that is left at the end of the run; it falls linearly."""
    gamma: float = Field(default=0.99, gt=0, le=1)
    """Discount factor."""
    tau: float = Field(default=0.01, gt=0, le=1)
    """Share of the critic that enters its target at every update."""
    alpha_init: float = Field(default=0.01, gt=0)
    """First value of the entropy temperature."""
    target_entropy: float = -5.0
    """Entropy that the temperature is tuned for."""
    demonstration_weight: float = Field(default=1.0, ge=0)
    """Factor of the behaviour term; 0 is plain SAC."""
    batch_size: int = Field(default=64, ge=1)
    """Transitions per update."""
    buffer_size: int = Field(default=100_000, ge=1)
    """Transitions the replay holds."""
    prioritized: bool = True
    """Draw transitions by their TD error instead of uniformly."""
    priority_exponent: float = Field(default=0.6, ge=0)
    """How strongly priorities act."""
    importance_exponent: float = Field(default=0.4, ge=0, le=1)
    """First value of beta, which grows to 1 over the run."""
    expert_bonus: float = Field(default=1.0, ge=0)
    """Added to the priority of demonstrations."""
    augmentation: Literal["so2", "none"] = "so2"
    """Rotate sampled transitions about the vertical."""
    augmentation_probability: float = Field(default=0.8, ge=0, le=1)
    """Share of the sampled transitions that is rotated."""

    def build(self, network: NetworkConfig, problem: Problem) -> SAC:
        """Return a freshly initialised learner."""
        return SAC(self, network, problem)


class SAC(Algorithm):
    """A squashed-Gaussian policy, twin critics on a shared encoder and a prioritised replay.

    Args:
        config: hyper-parameters.
        network: builds actor, encoder and critic.
        problem: shapes, device, seed and length of the run.
    """

    def __init__(self, config: SACConfig, network: NetworkConfig, problem: Problem) -> None:
        self.config = config
        self.problem = problem
        nets = network.build(ActorCriticSpec(problem.image_size, problem.actions.sequence))
        observation = [keys.PIXELS, keys.HOLDING]
        self.quantizer = DepthQuantizer(problem.max_depth_m)
        self.policy = _tanh_policy(_Acting(nets.actor, self.quantizer)).select_out_keys(keys.ACTION)
        self.policy.to(problem.device)
        self.loss = SACfDLoss(
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
        self.loss.make_value_estimator(gamma=config.gamma)
        self.target_updater = SoftUpdate(self.loss, tau=config.tau)
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=config.learning_rate, fused=True
        )
        self.scheduler = torch.optim.lr_scheduler.LinearLR(
            self.optimizer,
            start_factor=1.0,
            end_factor=config.learning_rate_end_factor,
            total_iters=problem.total_updates,
        )
        self.replay = make_replay_buffer(
            config.buffer_size,
            config.batch_size,
            codecs={keys.PIXELS: self.quantizer},
            prioritized=config.prioritized,
            priority_exponent=config.priority_exponent,
            weight_exponent=config.importance_exponent,
            expert_bonus=config.expert_bonus,
            seed=problem.seed,
        )
        self.augmentation = (
            SO2Augmentation(
                problem.actions.sequence,
                probability=config.augmentation_probability,
                seed=problem.seed,
            )
            if config.augmentation == "so2"
            else nn.Identity()
        )

    def extend(self, transitions: TensorDictBase) -> None:
        """Add transitions [N] to the replay; those with a fault are left out."""
        self.replay.extend(transitions)

    @property
    def replay_size(self) -> int:
        """Number of transitions in the replay."""
        return len(self.replay)

    def update(self) -> TensorDict:
        """Sample a batch, step networks and temperature, and refresh the priorities.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        if self.config.prioritized:
            self.replay.sampler.anneal(self.updates / max(self.problem.total_updates, 1))
        sampled = self.replay.sample().to(self.problem.device)
        batch = self.augmentation(sampled)
        scalars = self.loss(batch)
        total = scalars["loss_qvalue"] + scalars["loss_actor"] + scalars["loss_alpha"]
        if not torch.isfinite(total):
            values = {key: value.item() for key, value in scalars.items()}
            raise FloatingPointError(f"a loss is not finite at update {self.updates}: {values}")
        self.optimizer.zero_grad()
        total.backward()
        self.optimizer.step()
        self.scheduler.step()
        self.target_updater.step()
        if self.config.prioritized:
            # the sampler's trees are on the CPU, wherever the learner is
            self.replay.update_tensordict_priority(batch.select("index", keys.TD_ERROR).cpu())
        self.updates += 1
        return scalars.detach()

    def state_dict(self) -> dict[str, Any]:
        """Return networks, optimiser, schedule, augmentation and counter."""
        return {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scheduler": self.scheduler.state_dict(),
            "augmentation": self.augmentation.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.scheduler.load_state_dict(state["scheduler"])
        self.augmentation.load_state_dict(state["augmentation"])
        self.updates = state["updates"]

    def save_replay(self, folder: Path) -> None:
        """Write the replay into a folder: transitions, priorities and the state of its draws."""
        self.replay.dumps(folder)

    def load_replay(self, folder: Path) -> None:
        """Restore what `save_replay` wrote."""
        self.replay.loads(folder)


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
