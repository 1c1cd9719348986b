"""Hyper-parameters of RLPD."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field, model_validator
from typing_extensions import Self

from ba_torchrl.algorithms.config import ALGORITHMS
from ba_torchrl.algorithms.parts.imitation import Behaviour, NoImitation
from ba_torchrl.algorithms.parts.replay import Symmetric
from ba_torchrl.algorithms.sac_config import SACConfig
from ba_torchrl.core.choices import Imitation


@ALGORITHMS.register("rlpd")
class RLPDConfig(SACConfig):
    """Hyper-parameters of RLPD: those of SAC, and of the ensemble.

    Ball et al. (2023) have ten critics, choose a subset of one or two and the entropy backup for
    each environment, and take 20 critic updates per step in environments with vector observations.
    The values that SAC has too are SAC's.
    """

    learner: ClassVar[str] = "ba_torchrl.algorithms.rlpd:RLPD"
    is_compilable: ClassVar[bool] = False
    """False: the host draws members of the ensemble in each update."""

    replay: Symmetric = Symmetric()
    critics: int = Field(default=10, ge=2, le=100)
    """Number of critics in the ensemble."""
    subset: int = Field(default=2, ge=1)
    """Number of target critics, drawn in each update, whose minimum is the target."""
    critic_updates: int = Field(default=4, ge=1, le=1000)
    """Critic updates per update of the policy, each on another batch."""
    entropy_backup: bool = False
    """Whether targets have the entropy term."""
    imitation: Behaviour = NoImitation()
    """SACfD's behaviour term, which Ball et al. (2023) do not have."""

    @property
    def imitates(self) -> Imitation:
        """No action without such a term: all transitions have the same loss."""
        return "none" if self.init.name == "random" and self.imitation.name == "none" else "expert"

    @model_validator(mode="after")
    def _check_subset(self) -> Self:
        if self.subset > self.critics:
            raise ValueError(f"subset: {self.subset} of {self.critics} critics cannot be drawn")
        return self
