"""DAgger: imitation in the states that the policy visits (Ross et al., 2011).

The experts are functions of the scene, so the environment returns the expert's action in every
visited state. After the demonstrations, the executed action is the expert's with a probability beta
and the policy's otherwise; the stored label is always the expert's.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from ba_torchrl.algorithms.base import ALGORITHMS, Control, Problem
from ba_torchrl.algorithms.imitators import ImitationLearning, Imitator
from ba_torchrl.algorithms.learner import Learner
from ba_torchrl.algorithms.learner_config import LearnerConfig
from ba_torchrl.algorithms.seeds import SeedUse
from ba_torchrl.envs import keys
from ba_torchrl.modules.base import NetworkConfig


@ALGORITHMS.register("dagger")
class DAggerConfig(LearnerConfig):
    """Hyper-parameters of DAgger; the loss is that of `ba_torchrl.algorithms.bc`.

    Beta starts at one, as in Ross et al. (2011), section 3, and decreases with every update.
    A policy trained by few updates stops where the expert's action changes abruptly; with a beta of
    zero, such states then fill the replay. Several updates per step help (``updates_per_step``).
    """

    controls: ClassVar[frozenset[Control]] = frozenset({"close_loop", "open_loop"})

    beta_init: float = Field(default=1.0, ge=0, le=1)
    """Probability of executing the expert's action at the first update."""
    beta_updates: int = Field(default=1000, ge=1)
    """Updates over which that probability decreases linearly to zero, those on the demonstrations
    alone included."""
    replay: Literal["uniform"] = "uniform"
    init: Literal["random"] = "random"

    def build(self, network: NetworkConfig, problem: Problem) -> DAgger:
        """Return a freshly initialised learner.

        Raises:
            ValueError: the network does not support the task's images or actions.
        """
        return DAgger(self, network, problem)


class MixedPolicy(TensorDictModuleBase):
    """A policy that executes the expert's action in a random part of the steps.

    It does so under TorchRL's exploration type RANDOM only.

    Args:
        policy: from the observation to ``action``.
        imitator: maps the expert's action to one that the policy can choose.
        seed: of the choice between the two.
    """

    beta: Tensor

    def __init__(self, policy: TensorDictModuleBase, imitator: Imitator, seed: int) -> None:
        super().__init__()
        self.policy = policy
        self.register_buffer("beta", torch.zeros(()))  # among the weights that workers receive
        self.in_keys = list(policy.in_keys)
        self.out_keys = [keys.ACTION]
        self._imitator = imitator
        self._generator = torch.Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of a root TensorDict of any batch shape.

        Args:
            tensordict: observation; with ``expert_action`` if beta is positive.
        """
        out = self.policy(tensordict)
        if exploration_type() != ExplorationType.RANDOM or self.beta == 0:
            return out
        draws = torch.rand(
            *out.batch_size, 1, generator=self._generator, device="cpu", dtype=torch.float32
        )
        expert = self._imitator.nearest_action(out[keys.EXPERT_ACTION])
        is_expert = draws.to(expert.device) < self.beta
        return out.set(keys.ACTION, torch.where(is_expert, expert, out[keys.ACTION]))

    def get_generator_state(self) -> Tensor:
        """Return the state of the generator."""
        return self._generator.get_state()

    def set_generator_state(self, state: Tensor) -> None:
        """Restore the state of the generator, from any device."""
        self._generator.set_state(state.cpu())


class DAgger(ImitationLearning, Learner):
    """A policy trained on the expert's actions in the states of both.

    Args:
        config: hyper-parameters.
        network: builds the network of the policy.
        problem: images, actions, device, seed and length of the run.
    """

    config: DAggerConfig
    policy: MixedPolicy
    collects_expert_action: ClassVar[bool] = True

    def __init__(self, config: DAggerConfig, network: NetworkConfig, problem: Problem) -> None:
        super().__init__(config, network, problem)
        seed = problem.derived_seed(SeedUse.MIXTURE)
        self.policy = MixedPolicy(self.policy, self.imitator, seed).to(problem.device)
        self._set_beta()

    def update(self) -> TensorDict:
        """Take one step as `Learner.update`, and update beta.

        Raises:
            FloatingPointError: a loss is not finite.
        """
        scalars = super().update()
        self._set_beta()
        return scalars

    def _set_beta(self) -> None:
        config = self.config
        beta = config.beta_init * max(1 - self.updates / config.beta_updates, 0.0)
        self.policy.beta.fill_(beta)

    def state_dict(self) -> dict[str, Any]:
        """Return networks, optimiser, schedule, generators and number of updates."""
        return {**super().state_dict(), "mixture": self.policy.get_generator_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the learner from a `state_dict` of any device."""
        super().load_state_dict(state)
        self.policy.set_generator_state(state["mixture"])
        self._set_beta()
