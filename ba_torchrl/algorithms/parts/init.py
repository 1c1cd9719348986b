"""Initialisations of a policy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from ba_torchrl.core import keys
from ba_torchrl.core.config import Part

if TYPE_CHECKING:
    from tensordict.nn import ProbabilisticTensorDictSequential
    from torchrl.objectives import LossModule


class RandomInit(Part):
    """Random weights."""

    name: Literal["random"] = "random"
    updates: ClassVar[int] = 0

    def build(self, policy: ProbabilisticTensorDictSequential) -> list[tuple[int, LossModule]]:
        """Return no loss of first updates."""
        return []


class Cloning(Part):
    """The first updates of a run are behaviour cloning of the demonstrations.

    They do not train critics: without a behaviour term, SAC then unlearns the policy.
    """

    name: Literal["bc"] = "bc"
    updates: int = Field(default=500, ge=1)
    """Number of these updates, which `pretrain_updates` does not count."""
    entropy_weight: float = Field(default=0.0, ge=0)
    """Weight of the policy's negative entropy."""

    def build(self, policy: ProbabilisticTensorDictSequential) -> list[tuple[int, LossModule]]:
        """Return the number of updates and their loss."""
        from ba_torchrl.objectives.imitation import BehaviourCloningLoss

        loss = BehaviourCloningLoss(policy, "kl", self.entropy_weight)
        loss.set_keys(action=keys.TARGET_ACTION)
        loss.loss_mask_key = keys.IS_DEMONSTRATION
        return [(self.updates, loss)]


class ExploringCloning(Cloning):
    """Behaviour cloning of a policy that explores afterwards."""

    entropy_weight: float = Field(default=0.01, ge=0)
    """Weight of the policy's negative entropy, by default the default of SAC's `alpha_init`."""


Init = Annotated[RandomInit | Cloning, Field(discriminator="name")]
ExploringInit = Annotated[RandomInit | ExploringCloning, Field(discriminator="name")]
