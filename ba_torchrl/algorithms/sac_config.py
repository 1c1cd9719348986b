"""Hyper-parameters of Soft Actor-Critic and its variants."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator
from typing_extensions import Self

from ba_torchrl.algorithms.config import ALGORITHMS, LearnerConfig
from ba_torchrl.algorithms.parts.contrastive import Contrastive, NoContrastive
from ba_torchrl.algorithms.parts.imitation import Behaviour, Demonstrations
from ba_torchrl.algorithms.parts.init import ExploringInit, RandomInit
from ba_torchrl.algorithms.parts.rotation import NoRotation, Rotation
from ba_torchrl.algorithms.parts.views import NoViews, Views
from ba_torchrl.core.choices import Control, Imitation


@ALGORITHMS.register("sac")
class SACConfig(LearnerConfig):
    """Hyper-parameters of SAC and its variants, which are presets in ``configs/algorithm``.

    The defaults are those of SACfD in appendix G.2. Where the appendix gives no value, the default
    is that of the reference implementation, and the field says so.
    """

    learner: ClassVar[str] = "ba_torchrl.algorithms.sac:SAC"
    controls: ClassVar[frozenset[Control]] = frozenset({"close_loop"})

    gamma: float = Field(default=0.99, gt=0, le=1)
    """Discount factor."""
    tau: float = Field(default=0.01, gt=0, le=1)
    """Weight of the critic in the update of its target; reference implementation."""
    encoder_tau: float | None = Field(default=None, gt=0, le=1)
    """The same for the encoder; None for `tau`."""
    alpha_init: float = Field(default=0.01, gt=0)
    """Initial entropy temperature."""
    target_entropy: float | Literal["auto"] = -5.0
    """Entropy that the temperature is tuned for, nats; "auto" for minus the number of the action's
    components."""
    entropy_backup: bool = True
    """Whether targets have the entropy term, as in the reference implementation."""
    bootstrap_truncated: bool = True
    """Whether targets bootstrap on steps that the time limit truncates; the reference
    implementation does not."""
    init: ExploringInit = RandomInit()
    """Initialisation of the policy."""
    imitation: Behaviour = Demonstrations()
    """The behaviour term, which pulls the policy to demonstrated actions."""
    exploration_noise: float = Field(default=0.0, ge=0)
    """Standard deviation of Gaussian noise that is added to collected actions, which are then
    clipped to [-1, 1]. None in the appendix."""
    rotation: Rotation = NoRotation()
    """Rotation of transitions about the z axis; none in the appendix."""
    views: Views = NoViews()
    """Random views of sampled images."""
    contrastive: Contrastive = NoContrastive()
    """A loss of the encoder on pairs of views."""

    @model_validator(mode="after")
    def _check_options(self) -> Self:
        if self.contrastive.name != "none" and self.views.name == "none":
            raise ValueError("contrastive compares views: set views.name")
        return self

    @property
    def imitates(self) -> Imitation:
        """The expert's action, on demonstrations: the behaviour term."""
        return "expert"

    @property
    def first_updates(self) -> int:
        """Those of the initialisation or, if there are more, of the contrastive loss."""
        return max(self.init.updates, self.contrastive.updates)
