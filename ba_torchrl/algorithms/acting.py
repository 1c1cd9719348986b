"""Acting policies, whose input images are those that the learner's networks see."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import nn
from torchrl.envs import Transform
from torchrl.envs.utils import ExplorationType, exploration_type
from typing_extensions import Self

from ba_torchrl.core import keys
from ba_torchrl.core.evaluation_mode import evaluation_copy, set_evaluation_mode
from ba_torchrl.modules.steerable.layers import reuse_filters


@contextlib.contextmanager
def constant_weights() -> Iterator[None]:
    """Context in which no network's weights change: what depends on them alone is computed once."""
    with reuse_filters():
        yield


def acting_keys(policy: TensorDictModuleBase) -> list[NestedKey]:
    """Return the entries of a policy's output that an environment needs: ``action``, and what the
    policy carries to the next step."""
    carried = [key for key in policy.out_keys if key[0] == keys.CARRIED]
    return [keys.ACTION, *carried]


class ActingPolicy(TensorDictModuleBase):
    """A policy on an environment's observations, which are transformed as in training.

    It writes ``action`` and what the policy carries to the next step, nothing else. It is in
    evaluation mode, also after ``train()``, and shares the parameters and buffers of the given
    policy, whose mode does not change.

    Args:
        policy: from the transformed observation to ``action``.
        transforms: of the observation, in this order, such as the replay's codecs.
        exploration: changes the action, such as by noise; called under TorchRL's exploration type
            RANDOM only. None for the policy's own action.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        transforms: Iterable[Transform],
        exploration: TensorDictModuleBase | None = None,
    ) -> None:
        super().__init__()
        self.policy = evaluation_copy(policy)
        self.transforms = nn.ModuleList(transforms)
        self.exploration = exploration
        self.in_keys = list(policy.in_keys)
        self.out_keys = acting_keys(policy)
        self.eval()

    def train(self, mode: bool = True) -> Self:
        """Stay in evaluation mode."""
        return set_evaluation_mode(self)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of a root TensorDict of any batch shape."""
        seen = tensordict.select(*self.in_keys)
        if keys.CARRIED in tensordict:
            seen.set(keys.CARRIED, tensordict[keys.CARRIED])
        for transform in self.transforms:
            seen = transform(seen)
        out = self.policy(seen)
        if self.exploration is not None and exploration_type() is ExplorationType.RANDOM:
            out = self.exploration(out)
        return tensordict.update(out.select(*self.out_keys))
