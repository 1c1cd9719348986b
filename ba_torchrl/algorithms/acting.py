"""Acting policies, whose input images are those that the learner's networks see."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs.utils import ExplorationType, exploration_type

from ba_torchrl.envs import keys
from ba_torchrl.modules.steerable.layers import reuse_filters


@contextlib.contextmanager
def constant_weights() -> Iterator[None]:
    """Context in which no network's weights change: what depends on them alone is computed once."""
    with reuse_filters():
        yield


class ActingPolicy(TensorDictModuleBase):
    """A policy on images that are transformed as in training, such as by the replay's codecs.

    It writes ``action`` and nothing else.

    Args:
        policy: from the observation to ``action``.
        transforms: transform of each image, by key.
        exploration: changes the action, such as by noise; called under TorchRL's exploration type
            RANDOM only. None for the policy's own action.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        transforms: Mapping[str, nn.Module],
        exploration: TensorDictModuleBase | None = None,
    ) -> None:
        super().__init__()
        self.policy = policy
        self.transforms = nn.ModuleDict(transforms)
        self.exploration = exploration
        self.in_keys = list(policy.in_keys)
        self.out_keys = [keys.ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of a root TensorDict of any batch shape."""
        seen = tensordict.select(*self.in_keys)
        for key, transform in self.transforms.items():
            seen.set(key, transform(seen[key]))
        out = self.policy(seen)
        if self.exploration is not None and exploration_type() is ExplorationType.RANDOM:
            out = self.exploration(out)
        return tensordict.set(keys.ACTION, out[keys.ACTION])
