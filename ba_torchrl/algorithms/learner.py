"""Learner: gradient steps on batches of a replay, whatever the loss."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from ba_torchrl.algorithms.base import Algorithm, AlgorithmConfig, Problem
from ba_torchrl.data.replay.buffer import FrameReplayBuffer
from ba_torchrl.data.replay.prioritized import ExpertPrioritizedSampler
from ba_torchrl.data.replay.symmetric import SymmetricReplay
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.envs import keys


class LearnerConfig(AlgorithmConfig):
    """Hyper-parameters of every algorithm that learns from a replay."""

    learning_rate: float = Field(gt=0)
    """Adam's."""
    learning_rate_end_factor: float = Field(default=1.0, gt=0, le=1)
    """Share of the learning rate that is left at the end of the run; it falls linearly."""
    weight_decay: float = Field(default=0.0, ge=0)
    """Adam's L2 term."""
    gradient_clamp: float | None = Field(default=None, gt=0)
    """Bound of every element of the gradient; none leaves it as it is."""
    gamma: float = Field(gt=0, le=1)
    """Discount factor."""
    batch_size: int = Field(ge=1)
    """Transitions per update."""
    buffer_size: int = Field(default=100_000, ge=1)
    """Transitions the replay holds; of a split one, each half."""
    priority_exponent: float = Field(default=0.6, ge=0)
    """How strongly priorities act, where transitions are drawn by them."""
    importance_exponent: float = Field(default=0.4, ge=0, le=1)
    """First value of beta, which grows to 1 over the run."""
    expert_bonus: float = Field(default=1.0, ge=0)
    """Added to the priority of demonstrations."""
    augmentation_probability: float = Field(ge=0, le=1)
    """Share of the sampled transitions that is moved."""


class Learner(Algorithm):
    """A loss, its optimiser and target, and a replay.

    An update descends the sum of the loss module's ``loss_`` entries; where the replay draws by
    priority, it gets the new ones that the loss wrote into its input.

    Args:
        config: hyper-parameters.
        problem: shapes, device, seed and length of the run.
        policy: see `Algorithm`.
        loss: on the device, its value estimator made.
        target_updater: steps once per update.
        replay: a prioritised one is annealed and refreshed.
        augmentation: of sampled transitions.
    """

    def __init__(
        self,
        config: LearnerConfig,
        problem: Problem,
        *,
        policy: TensorDictModuleBase,
        loss: LossModule,
        target_updater: TargetNetUpdater,
        replay: FrameReplayBuffer | SymmetricReplay,
        augmentation: nn.Module,
    ) -> None:
        self.config = config
        self.problem = problem
        self.policy = policy
        self.loss = loss
        self.target_updater = target_updater
        self.replay = replay
        self.augmentation = augmentation
        self.optimizer = torch.optim.Adam(
            loss.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )
        self.scheduler = torch.optim.lr_scheduler.LinearLR(
            self.optimizer,
            start_factor=1.0,
            end_factor=config.learning_rate_end_factor,
            total_iters=problem.total_updates,
        )

    def to_transitions(self, data: TensorDictBase, *, is_expert: bool) -> TensorDict:
        """Return the transitions [N] that the replay stores of collected data."""
        images = (
            [keys.PIXELS] if self.problem.in_hand_shape is None else [keys.PIXELS, keys.IN_HAND]
        )
        return as_transitions(
            data, images, is_expert=is_expert, expert_action=self.stores_expert_action
        )

    def extend(self, transitions: TensorDictBase) -> None:
        """Add transitions [N] to the replay; those with a fault are left out."""
        self.replay.extend(transitions)

    @property
    def replay_size(self) -> int:
        """Number of transitions in the replay."""
        return len(self.replay)

    def update(self) -> TensorDict:
        """Sample a batch, step networks and target, and refresh the priorities if there are any.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        sampler = getattr(self.replay, "sampler", None)  # of a split replay: none, but two sides
        is_prioritized = isinstance(sampler, ExpertPrioritizedSampler)
        if is_prioritized:
            sampler.anneal(self.updates / max(self.problem.total_updates, 1))
        batch = self.augmentation(self.replay.sample().to(self.problem.device))
        scalars = self.loss(batch)
        total = sum(value for name, value in scalars.items() if name.startswith("loss_"))
        if not torch.isfinite(total):
            values = {key: value.item() for key, value in scalars.items()}
            raise FloatingPointError(f"a loss is not finite at update {self.updates}: {values}")
        self.optimizer.zero_grad()
        total.backward()
        if self.config.gradient_clamp is not None:
            nn.utils.clip_grad_value_(self.loss.parameters(), self.config.gradient_clamp)
        self.optimizer.step()
        self.scheduler.step()
        self.target_updater.step()
        if is_prioritized:
            # the sampler's trees are on the CPU, wherever the learner is
            self.replay.update_tensordict_priority(batch.select("index", keys.TD_ERROR).cpu())
        self.updates += 1
        return scalars.detach()

    def state_dict(self) -> dict[str, Any]:
        """Return networks, target, optimiser, schedule, augmentation and counter."""
        return {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scheduler": self.scheduler.state_dict(),
            "augmentation": self.augmentation.state_dict(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        for name in ("loss", "optimizer", "scheduler", "augmentation"):
            getattr(self, name).load_state_dict(state[name])
        self.updates = state["updates"]

    def save_replay(self, folder: Path) -> None:
        """Write the replay into a folder: transitions, priorities and the state of its draws."""
        self.replay.dumps(folder)

    def load_replay(self, folder: Path) -> None:
        """Restore what `save_replay` wrote."""
        self.replay.loads(folder)
