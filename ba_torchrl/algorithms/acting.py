"""Acting policies, whose input images are those that the replay returns."""

from __future__ import annotations

from collections.abc import Mapping

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from ba_torchrl.data.replay.codecs import ImageCodec
from ba_torchrl.envs import keys


class ActingPolicy(TensorDictModuleBase):
    """A policy on images that pass through the replay's codecs, as in training.

    It writes ``action`` and nothing else.

    Args:
        policy: from the observation to ``action``.
        codecs: the replay's codec of each image, by key.
    """

    def __init__(self, policy: TensorDictModuleBase, codecs: Mapping[str, ImageCodec]) -> None:
        super().__init__()
        self.policy = policy
        self.codecs = nn.ModuleDict(codecs)
        self.in_keys = list(policy.in_keys)
        self.out_keys = [keys.ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of a root TensorDict of any batch shape."""
        seen = tensordict.select(*self.in_keys)
        for key, codec in self.codecs.items():
            seen.set(key, codec(seen[key]))
        return tensordict.set(keys.ACTION, self.policy(seen)[keys.ACTION])
