"""Policies on the actors of `ba_torchrl.modules.base.ActorCritic`."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Independent, Normal
from torchrl.modules import ProbabilisticActor, TanhNormal, TruncatedNormal
from torchrl.modules.distributions.continuous import SafeTanhTransform

from ba_torchrl.core import keys


class UnitTanhNormal(TanhNormal):
    """TorchRL's tanh of a Gaussian variable with the range [-1, 1].

    TorchRL's constructor compares the bounds as tensors on the device and reads the result on the
    host, which then waits for the device in every forward pass; this one knows the bounds. The
    density is exact, where the reference implementation adds 1e-6 to 1 - a^2.
    """

    def __init__(self, loc: Tensor, scale: Tensor) -> None:
        self.device = loc.device
        self.low, self.high = loc.new_full((), -1.0), loc.new_full((), 1.0)
        self.non_trivial_min = self.non_trivial_max = False
        self.tanh_loc = False
        self.upscale = 5.0  # TorchRL's default, unused without tanh_loc
        self.update(loc, scale)

    def update(self, loc: Tensor, scale: Tensor) -> None:
        """Set location and scale [..., A]."""
        self.loc, self.scale = loc, scale
        base = Independent(Normal(loc, scale), min(1, loc.ndim))
        super(TanhNormal, self).__init__(base, SafeTanhTransform())


def squashed_gaussian_policy(actor: nn.Module, in_keys: Sequence[str]) -> ProbabilisticActor:
    """Return the policy whose action is the tanh of a Gaussian variable (appendix G.2).

    Args:
        actor: from the observation to (loc, scale), each [..., A].
        in_keys: keys of the observation, in the order of the actor's arguments.
    """
    return ProbabilisticActor(
        TensorDictModule(actor, in_keys=list(in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[keys.ACTION],
        distribution_class=UnitTanhNormal,
    )


class ModeGreedyTruncatedNormal(TruncatedNormal):
    """TorchRL's truncated normal distribution, whose deterministic sample is the mode."""

    @property
    def deterministic_sample(self) -> Tensor:
        """The mode [..., A]; TorchRL's is the mean, which is further from the ends of the range."""
        return self.mode


class BoundedScale(nn.Module):
    """An actor with a lower and an upper bound of its standard deviations.

    Args:
        actor: from the observation to (loc, scale), each [..., A].
    """

    def __init__(self, actor: nn.Module, low: float, high: float) -> None:
        super().__init__()
        self.actor = actor
        self.low = low
        self.high = high

    def forward(self, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return (loc, scale), each [..., A]."""
        loc, scale = self.actor(*observation)
        return loc, scale.clamp(self.low, self.high)


def truncated_gaussian_policy(
    actor: nn.Module, in_keys: Sequence[str], *, std_min: float
) -> ProbabilisticActor:
    """Return the policy whose action is a Gaussian variable truncated to [-1, 1].

    Its mode is tanh(loc). In contrast to the squashed Gaussian, the likelihood of actions at the
    ends of the range is bounded.

    Args:
        actor: from the observation to (loc, scale), each [..., A].
        in_keys: keys of the observation, in the order of the actor's arguments.
        std_min: least standard deviation; the greatest is 1.
    """
    bounded = BoundedScale(actor, std_min, 1.0)
    return ProbabilisticActor(
        TensorDictModule(bounded, in_keys=list(in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[keys.ACTION],
        distribution_class=ModeGreedyTruncatedNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0, "upscale": 1.0, "tanh_loc": True},
    )
