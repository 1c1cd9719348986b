"""Policies on the actors of `ba_torchrl.modules.base.ActorCritic`."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal

from ba_torchrl.envs import keys


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
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
    )
