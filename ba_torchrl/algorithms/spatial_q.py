"""Q-learning in spatial action spaces: DQN, and ADET, DQfD, SDQfD from demonstrations (G.1)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import HardUpdate

from ba_torchrl.actions import OpenLoopActions
from ba_torchrl.algorithms.base import ALGORITHMS, Algorithm, AlgorithmConfig, Problem
from ba_torchrl.data.quantization import HalfPrecision
from ba_torchrl.data.replay import FrameReplayBuffer, make_replay_buffer
from ba_torchrl.data.rigid_augmentation import Motions, RigidAugmentation
from ba_torchrl.data.split import ExpertSplitReplay
from ba_torchrl.envs import keys
from ba_torchrl.modules.base import NetworkConfig
from ba_torchrl.modules.spatial import SpatialSpec
from ba_torchrl.modules.spatial_policy import (
    SpatialActions,
    SpatialPolicy,
    SpatialValues,
    spatial_policy,
)
from ba_torchrl.objectives.dqn import Demonstrations, LevelDQNLoss


@ALGORITHMS.register("spatial_q")
class SpatialQConfig(AlgorithmConfig):
    """Hyper-parameters of spatial Q-learning; presets in ``configs/algorithm`` name its members.

    The defaults are those of SDQfD in the paper (appendix G.1).
    """

    control: ClassVar[Literal["open_loop", "close_loop"]] = "open_loop"

    demonstrations: Demonstrations = "sdqfd"
    """The term on the experts' actions: "none", "dqfd", "sdqfd" or "adet"."""
    demonstration_weight: float = Field(default=0.1, ge=0)
    """Factor of that term."""
    margin: float = Field(default=0.1, ge=0)
    """Of the margin terms: experts' actions shall be better by this much."""
    first_beta: float = Field(default=100.0, gt=0)
    """Inverse temperature of ADET where the pixel is chosen."""
    later_beta: float = Field(default=1.0, gt=0)
    """Inverse temperature of ADET at the levels after it."""
    learning_rate: float = Field(default=1e-4, gt=0)
    """Adam's."""
    learning_rate_end_factor: float = Field(default=1.0, gt=0, le=1)
    """Share of the learning rate that is left at the end of the run; it falls linearly."""
    weight_decay: float = Field(default=1e-5, ge=0)
    """Adam's L2 term."""
    gradient_clamp: float = Field(default=1.0, gt=0)
    """Bound of every element of the gradient."""
    gamma: float = Field(default=0.95, gt=0, le=1)
    """Discount factor."""
    target_interval: int = Field(default=100, ge=1)
    """Updates between copies of the network to its target."""
    batch_size: int = Field(default=16, ge=1)
    """Transitions per update."""
    buffer_size: int = Field(default=100_000, ge=1)
    """Transitions the replay holds; of a split one, each half."""
    replay: Literal["split", "prioritized", "uniform"] = "split"
    """Half of every batch from demonstrations, or by TD error with the experts' bonus, or any."""
    priority_exponent: float = Field(default=0.6, ge=0)
    """How strongly priorities act."""
    importance_exponent: float = Field(default=0.4, ge=0, le=1)
    """First value of beta, which grows to 1 over the run."""
    expert_bonus: float = Field(default=1.0, ge=0)
    """Added to the priority of demonstrations."""
    augmentation: Motions = "none"
    """Rigid motions of sampled transitions: "translation", "cn", "d4" or "se2"."""
    augmentation_probability: float = Field(default=1.0, ge=0, le=1)
    """Share of the sampled transitions that is moved."""
    augmentation_order: int = Field(default=16, ge=1)
    """n of "cn"."""
    epsilon_init: float = Field(default=0.0, ge=0, le=1)
    """Share of random actions at the start; the paper acts greedily."""
    epsilon_end: float = Field(default=0.0, ge=0, le=1)
    """Share of random actions at the end."""
    epsilon_updates: int = Field(default=1000, ge=1)
    """Updates over which one becomes the other, linearly."""

    def build(self, network: NetworkConfig, problem: Problem) -> SpatialQ:
        """Return a freshly initialised learner.

        Raises:
            ValueError: the network does not go with the task's images or actions.
        """
        return SpatialQ(self, network, problem)


class SpatialQ(Algorithm):
    """A network of spatial Q values, its target, and a replay with demonstrations.

    Args:
        config: hyper-parameters.
        network: builds the network.
        problem: shapes, device, seed and length of the run.

    Raises:
        ValueError: the network or the augmentation does not go with the task's images or actions.
    """

    def __init__(self, config: SpatialQConfig, network: NetworkConfig, problem: Problem) -> None:
        self.config = config
        self.problem = problem
        actions = problem.actions
        assert isinstance(actions, OpenLoopActions), "open_loop tasks have no other"
        channels, size = problem.in_hand_shape
        spec = SpatialSpec(
            image_size=problem.image_size,
            in_hand_size=size,
            in_hand_channels=channels,
            components=tuple(name for name in actions.components if name != "p"),
            half_rotation=actions.half_rotation,
        )
        net = network.build(spec)
        self.augmentation = RigidAugmentation(
            config.augmentation,
            actions,
            seed=problem.seed,
            probability=config.augmentation_probability,
            order=config.augmentation_order,
        )
        values = SpatialValues(net, SpatialActions(actions, net.levels)).to(problem.device)
        rounding = HalfPrecision(problem.max_depth_m)
        self.acting = SpatialPolicy(values, rounding, seed=problem.seed).to(problem.device)
        self.policy = spatial_policy(self.acting)
        self.loss = LevelDQNLoss(
            values,
            demonstrations=config.demonstrations,
            demonstration_weight=config.demonstration_weight,
            margin=config.margin,
            first_beta=config.first_beta,
            later_beta=config.later_beta,
        ).to(problem.device)
        self.loss.make_value_estimator(gamma=config.gamma)
        # TorchRL copies at the step after its interval: one less makes the period ours.
        self.target_updater = HardUpdate(
            self.loss, value_network_update_interval=config.target_interval - 1
        )
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(),
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
        self.replay = self._make_replay(rounding)
        self._set_epsilon()

    def _make_replay(self, rounding: HalfPrecision) -> FrameReplayBuffer | ExpertSplitReplay:
        config, codecs = self.config, {keys.PIXELS: rounding, keys.IN_HAND: rounding}
        if config.replay == "split":
            return ExpertSplitReplay(
                config.buffer_size, config.batch_size, codecs=codecs, seed=self.problem.seed
            )
        return make_replay_buffer(
            config.buffer_size,
            config.batch_size,
            codecs=codecs,
            seed=self.problem.seed,
            prioritized=config.replay == "prioritized",
            priority_exponent=config.priority_exponent,
            weight_exponent=config.importance_exponent,
            expert_bonus=config.expert_bonus,
        )

    def _set_epsilon(self) -> None:
        config = self.config
        share = min(self.updates / config.epsilon_updates, 1.0)
        epsilon = config.epsilon_init + share * (config.epsilon_end - config.epsilon_init)
        self.acting.epsilon.fill_(epsilon)

    def extend(self, transitions: TensorDictBase) -> None:
        """Add transitions [N] to the replay; those with a fault are left out."""
        self.replay.extend(transitions)

    @property
    def replay_size(self) -> int:
        """Number of transitions in the replay."""
        return len(self.replay)

    def update(self) -> TensorDict:
        """Sample a batch, step the network, and refresh the priorities if there are any.

        Raises:
            FloatingPointError: the loss is not finite.
        """
        prioritized = self.config.replay == "prioritized"
        if prioritized:
            self.replay.sampler.anneal(self.updates / max(self.problem.total_updates, 1))
        batch = self.augmentation(self.replay.sample().to(self.problem.device))
        scalars = self.loss(batch)
        total = scalars["loss_qvalue"] + scalars["loss_demonstration"]
        if not torch.isfinite(total):
            values = {key: value.item() for key, value in scalars.items()}
            raise FloatingPointError(f"a loss is not finite at update {self.updates}: {values}")
        self.optimizer.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_value_(self.loss.parameters(), self.config.gradient_clamp)
        self.optimizer.step()
        self.scheduler.step()
        self.target_updater.step()
        if prioritized:
            # the sampler's trees are on the CPU, wherever the learner is
            self.replay.update_tensordict_priority(batch.select("index", keys.TD_ERROR).cpu())
        self.updates += 1
        self._set_epsilon()
        return scalars.detach()

    def state_dict(self) -> dict[str, Any]:
        """Return network, target, optimiser, schedule, generators and counter."""
        return {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scheduler": self.scheduler.state_dict(),
            "augmentation": self.augmentation.state_dict(),
            "acting": self.acting.get_generator_state(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.scheduler.load_state_dict(state["scheduler"])
        self.augmentation.load_state_dict(state["augmentation"])
        self.acting.set_generator_state(state["acting"])
        self.updates = state["updates"]
        self.target_updater.counter = self.updates % self.config.target_interval
        self._set_epsilon()

    def save_replay(self, folder: Path) -> None:
        """Write the replay into a folder: transitions, priorities and the state of its draws."""
        self.replay.dumps(folder)

    def load_replay(self, folder: Path) -> None:
        """Restore what `save_replay` wrote."""
        self.replay.loads(folder)
