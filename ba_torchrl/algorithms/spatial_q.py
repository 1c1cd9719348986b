"""Q-learning in spatial action spaces: DQN, and ADET, DQfD, SDQfD from demonstrations (G.1)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field
from tensordict import TensorDict
from torchrl.objectives import HardUpdate

from ba_torchrl.actions import OpenLoopActions
from ba_torchrl.algorithms.base import ALGORITHMS, Problem
from ba_torchrl.algorithms.learner import Learner, LearnerConfig
from ba_torchrl.data.augmentation.rigid import RigidAugmentation, RigidMotions
from ba_torchrl.data.replay.buffer import FrameReplayBuffer, make_replay_buffer
from ba_torchrl.data.replay.codecs import HalfPrecision
from ba_torchrl.data.replay.symmetric import SymmetricReplay
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
class SpatialQConfig(LearnerConfig):
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
    weight_decay: float = Field(default=1e-5, ge=0)
    gradient_clamp: float | None = Field(default=1.0, gt=0)
    gamma: float = Field(default=0.95, gt=0, le=1)
    batch_size: int = Field(default=16, ge=1)
    augmentation_probability: float = Field(default=1.0, ge=0, le=1)
    target_interval: int = Field(default=100, ge=1)
    """Updates between copies of the network to its target."""
    replay: Literal["split", "prioritized", "uniform"] = "split"
    """Half of every batch from demonstrations, or by TD error with the experts' bonus, or any."""
    augmentation: RigidMotions = "none"
    """Rigid motions of sampled transitions: "translation", "cn", "d4" or "se2"."""
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


class SpatialQ(Learner):
    """A network of spatial Q values, its target, and a replay with demonstrations.

    Args:
        config: hyper-parameters.
        network: builds the network.
        problem: shapes, device, seed and length of the run.

    Raises:
        ValueError: the network or the augmentation does not go with the task's images or actions.
    """

    def __init__(self, config: SpatialQConfig, network: NetworkConfig, problem: Problem) -> None:
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
        values = SpatialValues(net, SpatialActions(actions, net.levels)).to(problem.device)
        rounding = HalfPrecision(problem.max_depth_m)
        self.acting = SpatialPolicy(values, rounding, seed=problem.seed).to(problem.device)
        loss = LevelDQNLoss(
            values,
            demonstrations=config.demonstrations,
            demonstration_weight=config.demonstration_weight,
            margin=config.margin,
            first_beta=config.first_beta,
            later_beta=config.later_beta,
        ).to(problem.device)
        loss.make_value_estimator(gamma=config.gamma)
        super().__init__(
            config,
            problem,
            policy=spatial_policy(self.acting),
            loss=loss,
            # TorchRL copies at the step after its interval: one less makes the period ours.
            target_updater=HardUpdate(
                loss, value_network_update_interval=config.target_interval - 1
            ),
            replay=_make_replay(config, rounding, problem.seed),
            augmentation=RigidAugmentation(
                config.augmentation,
                actions,
                seed=problem.seed,
                probability=config.augmentation_probability,
                order=config.augmentation_order,
            ),
        )
        self._set_epsilon()

    def _set_epsilon(self) -> None:
        config = self.config
        share = min(self.updates / config.epsilon_updates, 1.0)
        epsilon = config.epsilon_init + share * (config.epsilon_end - config.epsilon_init)
        self.acting.epsilon.fill_(epsilon)

    def update(self) -> TensorDict:
        """Take one step, see `Learner.update`, and move the share of random actions.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        scalars = super().update()
        self._set_epsilon()
        return scalars

    def state_dict(self) -> dict[str, Any]:
        """Return network, target, optimiser, schedule, generators and counter."""
        return {**super().state_dict(), "acting": self.acting.get_generator_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        super().load_state_dict(state)
        self.acting.set_generator_state(state["acting"])
        self.target_updater.counter = self.updates % self.config.target_interval
        self._set_epsilon()


def _make_replay(
    config: SpatialQConfig, rounding: HalfPrecision, seed: int
) -> FrameReplayBuffer | SymmetricReplay:
    codecs = {keys.PIXELS: rounding, keys.IN_HAND: rounding}
    if config.replay == "split":
        return SymmetricReplay(config.buffer_size, config.batch_size, codecs=codecs, seed=seed)
    return make_replay_buffer(
        config.buffer_size,
        config.batch_size,
        codecs=codecs,
        seed=seed,
        prioritized=config.replay == "prioritized",
        priority_exponent=config.priority_exponent,
        weight_exponent=config.importance_exponent,
        expert_bonus=config.expert_bonus,
    )
