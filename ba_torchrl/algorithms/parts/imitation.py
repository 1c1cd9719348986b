"""Terms of a loss on demonstrated actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from ba_torchrl.core.choices import ActionDistance
from ba_torchrl.core.config import Part

if TYPE_CHECKING:
    from ba_torchrl.demonstrations.episodes import EpisodeAssembler


class _Behaviour(Part):
    def build(self) -> EpisodeAssembler | None:
        """Return what assembles collected episodes before they are stored; None for steps."""
        return None


class NoImitation(_Behaviour):
    """Demonstrations are transitions like the others."""

    name: Literal["none"] = "none"
    loss_options: ClassVar[dict[str, Any]] = {"demonstration_weight": 0.0}


class Demonstrations(_Behaviour):
    """The behaviour term on demonstrations."""

    name: Literal["demonstrations"] = "demonstrations"
    weight: float = Field(default=1.0, gt=0)
    """Weight of the behaviour term; reference implementation."""
    distance: ActionDistance = "mse"
    """Distance of the policy's action from the demonstrated one: the squared error of the reference
    implementation, or "kl", whose gradient does not vanish at the ends of the range."""

    @property
    def loss_options(self) -> dict[str, Any]:
        """Arguments of `SACfDLoss`."""
        return {"demonstration_weight": self.weight, "demonstration_distance": self.distance}


class Successes(Demonstrations):
    """Collected episodes that succeed count as demonstrations (self-imitation; Oh et al., 2018).

    The behaviour term and the expert bonus apply to them, until demonstrations fill half of the
    replay. Transitions then enter the replay when their episode ends. Not in the appendix.
    """

    name: Literal["successes"] = "successes"
    weight: float = Field(default=1.0, ge=0)
    """Weight of the behaviour term; 0 for a replay that draws demonstrations more often."""

    def build(self) -> EpisodeAssembler:
        from ba_torchrl.demonstrations.episodes import EpisodeAssembler

        return EpisodeAssembler()


Behaviour = Annotated[NoImitation | Demonstrations | Successes, Field(discriminator="name")]


class Margin(Part):
    """A margin of the values of demonstrated actions: "dqfd" to the largest of the others, "sdqfd"
    to all others."""

    name: Literal["dqfd", "sdqfd"]
    weight: float = Field(default=0.1, gt=0)
    """Weight of the term."""
    margin: float = Field(default=0.1, ge=0)
    """Margin between demonstrated actions and others."""

    @property
    def loss_options(self) -> dict[str, Any]:
        """Arguments of `LevelDQNLoss`."""
        return {"demonstration_weight": self.weight, "margin": self.margin}


class ADET(Part):
    """The cross-entropy of a softmax of the values with demonstrated actions."""

    name: Literal["adet"] = "adet"
    weight: float = Field(default=0.01, gt=0)
    """Weight of the term; reference implementation."""
    first_beta: float = Field(default=100.0, gt=0)
    """Inverse temperature at the first level; reference implementation."""
    later_beta: float = Field(default=1.0, gt=0)
    """Inverse temperature at later levels; reference implementation."""

    @property
    def loss_options(self) -> dict[str, Any]:
        """Arguments of `LevelDQNLoss`."""
        betas = {"first_beta": self.first_beta, "later_beta": self.later_beta}
        return {"demonstration_weight": self.weight, **betas}


SpatialImitation = Annotated[NoImitation | Margin | ADET, Field(discriminator="name")]
