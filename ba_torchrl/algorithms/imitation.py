"""Imitation of an expert: behaviour cloning, and DAgger in the states that the policy visits.

The policy of close-loop tasks is the squashed Gaussian of SAC, that of open-loop tasks the greedy
policy of a spatial Q network. The experts are functions of the scene, so the environment returns
the expert's action in every state that DAgger visits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import Transform
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.objectives import LossModule

from ba_torchrl.algorithms.base import ALGORITHMS, Control, Learner, LearnerConfig, Problem, SeedUse
from ba_torchrl.algorithms.parts.replay import Uniform
from ba_torchrl.algorithms.parts.rotation import AnyRotation, NoRotation, Sampled
from ba_torchrl.algorithms.spatial_actions import (
    demonstration_on_grid,
    make_spatial_values,
)
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.generators import seeded_generator
from ba_torchrl.data.transitions import Imitation
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.base import NetworkConfig
from ba_torchrl.modules.spatial.policy import SpatialActions, SpatialPolicy, spatial_policy
from ba_torchrl.objectives.imitation import BehaviourCloningLoss, LevelCrossEntropyLoss


class ImitationConfig(LearnerConfig):
    """Hyper-parameters of a policy that is trained on the expert's actions alone.

    The loss is the divergence of sampled actions from the expert's in close-loop tasks, and the
    cross-entropy of the Q network's choices in open-loop tasks; see
    `ba_torchrl.objectives.imitation`.
    """

    controls: ClassVar[frozenset[Control]] = frozenset({"close_loop", "open_loop"})

    rotation: AnyRotation = NoRotation()
    """Of sampled transitions: about the z axis in close loop, rigid transforms in open loop."""
    replay: Uniform = Uniform()

    def check(self, network: NetworkConfig, control: Control) -> None:
        """As for `LearnerConfig`; a rotation of the other control is refused too."""
        super().check(network, control)
        own = isinstance(self.rotation, Sampled) == (control == "close_loop")
        if not own and self.rotation.name != "none":
            other = "open_loop" if control == "close_loop" else "close_loop"
            raise ConfigError(
                f"algorithm.rotation.name: {self.rotation.name!r} transforms {other} "
                f"transitions; leave it at 'none' for {control} tasks"
            )


@ALGORITHMS.register("bc")
class BCConfig(ImitationConfig):
    """Hyper-parameters of behaviour cloning (Pomerleau, "ALVINN: An Autonomous Land Vehicle in a
    Neural Network", 1989), whose updates are all on the demonstrations."""

    collects: ClassVar[bool] = False
    imitates: ClassVar[Imitation] = "expert"

    def build(self, network: NetworkConfig, problem: Problem) -> BC:
        """Return a freshly initialised learner."""
        return BC(self, network, problem)


@ALGORITHMS.register("dagger")
class DAggerConfig(ImitationConfig):
    """Hyper-parameters of DAgger (Ross et al., 2011).

    After the demonstrations, the executed action is the expert's with a probability beta and the
    policy's otherwise. Beta starts at one, as in Ross et al. (2011), section 3, and decreases with
    every update. A policy trained by few updates stops where the expert's action changes abruptly;
    with a beta of zero, such states then fill the replay. Several updates per step help
    (``updates_per_step``).
    """

    imitates: ClassVar[Imitation] = "expert_everywhere"

    beta_init: float = Field(default=1.0, ge=0, le=1)
    """Probability of executing the expert's action at the first update."""
    beta_updates: int = Field(default=1000, ge=1)
    """Updates over which that probability decreases linearly to zero, those on the demonstrations
    alone included."""

    def build(self, network: NetworkConfig, problem: Problem) -> DAgger:
        """Return a freshly initialised learner."""
        return DAgger(self, network, problem)


class BC(Learner):
    """A policy trained on demonstrations only."""

    config: ImitationConfig

    @property
    def actions(self) -> SpatialActions | None:
        """The grid of actions of an open-loop policy; None in close loop."""
        is_grid = self.problem.control == "open_loop"
        return self.trained_policy.module.values.actions if is_grid else None

    def make_networks(self, network: NetworkConfig) -> nn.Module:
        """Return the actor of an actor-critic network, or a spatial Q network."""
        if self.problem.control == "close_loop":
            return network.build(self.network_spec).actor.to(self.problem.device)
        return make_spatial_values(network, self.problem, self.images)

    def make_policy(self, networks: nn.Module) -> TensorDictModuleBase:
        """Return the policy."""
        if self.problem.control == "close_loop":
            return squashed_gaussian_policy(networks, self.observation_keys)
        seed = self.problem.derived_seed(SeedUse.EXPLORATION)
        return spatial_policy(SpatialPolicy(networks, seed))

    def make_loss(self, networks: nn.Module) -> LossModule:
        """Return the divergence of sampled actions from the expert's, with gradients at the ends of
        the range, or the cross-entropy of every level's values with the expert's choice."""
        if self.problem.control == "close_loop":
            loss = BehaviourCloningLoss(self.make_policy(networks), "kl")
        else:
            loss = LevelCrossEntropyLoss(networks)
        loss.set_keys(action=keys.TARGET_ACTION)
        return loss

    def make_transforms(self, networks: nn.Module) -> list[Transform]:
        """Return the rotation or the rigid transforms of sampled transitions."""
        rotation = self.config.rotation
        if self.problem.control == "close_loop":
            return rotation.build(self.problem, self.images, self.vectors)
        return rotation.build(self.problem, self.images, networks.actions, keys.TARGET_ACTION)

    def nearest_action(self, action: Tensor) -> Tensor:
        """Return the nearest action that the policy can choose."""
        return action if self.actions is None else self.actions.nearest(action)

    def on_demonstrations(self, episodes: Sequence[TensorDictBase]) -> None:
        """Store the steps of demonstrations [T] in which the expert's action is known, as an action
        that the policy can choose."""
        for episode in episodes:
            if self.actions is not None:
                episode = demonstration_on_grid(episode, self.actions, self.images)
            data = self.to_transitions(episode, is_demonstration=True)
            self.extend(data[data[keys.IS_DEMONSTRATION].squeeze(-1)])


class MixedPolicy(TensorDictModuleBase):
    """A policy that executes the expert's action in a random part of the steps.

    It does so under TorchRL's exploration type RANDOM only.

    Args:
        policy: from the observation to ``action``.
        actions: the actions that the policy can choose; None for all.
        seed: of the choice between the two.
    """

    beta: Tensor

    def __init__(
        self, policy: TensorDictModuleBase, actions: SpatialActions | None, seed: int
    ) -> None:
        super().__init__()
        self.policy = policy
        self.register_buffer("beta", torch.zeros(()))  # among the weights that workers receive
        self.in_keys = list(policy.in_keys)
        self.out_keys = [keys.ACTION]
        self._actions = actions
        self.generator = seeded_generator(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of a root TensorDict of any batch shape.

        Args:
            tensordict: observation; with ``expert_action`` if beta is positive.
        """
        out = self.policy(tensordict)
        if exploration_type() != ExplorationType.RANDOM or self.beta == 0:
            return out
        draws = torch.rand(
            *out.batch_size, 1, generator=self.generator, device="cpu", dtype=torch.float32
        )
        expert = out[keys.EXPERT_ACTION]
        if self._actions is not None:
            expert = self._actions.nearest(expert)
        is_expert = draws.to(expert.device) < self.beta
        return out.set(keys.ACTION, torch.where(is_expert, expert, out[keys.ACTION]))


class DAgger(BC):
    """A policy trained on the expert's actions in the states of both."""

    config: DAggerConfig
    policy: MixedPolicy

    def __init__(self, config: DAggerConfig, network: NetworkConfig, problem: Problem) -> None:
        super().__init__(config, network, problem)
        seed = problem.derived_seed(SeedUse.MIXTURE)
        self.policy = MixedPolicy(self.policy, self.actions, seed).to(problem.device).eval()
        self._set_beta()

    def update(self) -> TensorDict:
        """Take one step as `Learner.update`, and update beta."""
        scalars = super().update()
        self._set_beta()
        return scalars

    def _set_beta(self) -> None:
        config = self.config
        beta = config.beta_init * max(1 - self.updates / config.beta_updates, 0.0)
        self.policy.beta.fill_(beta)

    def generators(self) -> dict[str, torch.Generator]:
        """Return the generator of the choice between the actions of policy and expert."""
        return {"mixture": self.policy.generator}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the learner from a `state_dict` of any device."""
        super().load_state_dict(state)
        self._set_beta()
