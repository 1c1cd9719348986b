"""Flow matching: imitation of chunks of actions by a network that draws them from noise."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Protocol

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ba_torchrl.core import keys
from ba_torchrl.objectives.imitation import ImitationLoss
from ba_torchrl.objectives.networks import Reduction, check_network


class ChunkNetwork(Protocol):
    """A network of chunks, in two parts: what it sees is encoded once for several noises."""

    encoder: nn.Module
    """From the observation's entries to features [..., F]."""
    head: nn.Module
    """From features [..., F], a noisy chunk [..., T, A] and the time [...] to the clean chunk."""


class FlowMatchingLoss(ImitationLoss):
    """Imitation of action chunks by a rectified flow: the squared error of the predicted chunk.

    For each chunk x of the data, noise n ~ N(0, 1) and a time t ~ U(0, 1) are drawn, and the
    network predicts x from (1 - t) n + t x. TorchRL's ``DiffusionBCLoss`` predicts the noise of a
    discrete schedule for one action without an image encoder; this loss encodes an image once for
    several draws, since the encoder takes most of the time.

    Args:
        actor_network: a module of a `ChunkNetwork` that reads the observation and, last, the noise.
        draws: noises and times for each chunk.
        reduction: "mean", "sum", or "none" for one loss per sample; "mean" if None.

    Raises:
        ValueError: there are no draws.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from ba_torchrl.modules.chunks import ChunkFlow, ChunkHead
        >>> from ba_torchrl.objectives import FlowMatchingLoss
        >>> head = ChunkHead(16, torch.eye(5)[None], torch.zeros(1, 0, 0), horizon=4)
        >>> flow = ChunkFlow(torch.nn.Linear(3, 16), head)
        >>> flow = TensorDictModule(flow, ["observation", "noise"], ["action_chunk"])
        >>> loss = FlowMatchingLoss(flow)
        >>> chunks, mask = torch.rand(8, 4, 5), torch.ones(8, 4, dtype=torch.bool)
        >>> data = {"observation": torch.rand(8, 3), "target_chunk": chunks}
        >>> data = TensorDict({**data, "target_chunk_mask": mask}, [8])
        >>> loss(data)["loss_flow"].backward()
        >>> flow(data.set("noise", torch.randn(8, 4, 5)))["action_chunk"].shape
        torch.Size([8, 4, 5])
    """

    @dataclass
    class _AcceptedKeys:
        """Entries that ``set_keys`` can rename."""

        action: NestedKey = keys.TARGET_CHUNK
        is_valid: NestedKey = keys.TARGET_CHUNK_MASK

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    out_keys = ("loss_flow",)

    def __init__(
        self,
        actor_network: TensorDictModule,
        draws: int = 4,
        reduction: Reduction | None = None,
    ) -> None:
        if draws < 1:
            raise ValueError(f"draws must be at least 1, got {draws}")
        check_network("actor_network", actor_network, "module.encoder")
        super().__init__(reduction)
        self.convert_to_functional(actor_network, "actor_network")
        self.draws = draws
        self._set_observation(actor_network.in_keys[:-1])

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_flow``.

        Args:
            tensordict: observations [...], chunks [..., T, A], and which of their actions count
                [..., T].
        """
        self._prepare(tensordict, self.tensor_keys.action, 2)
        chunk, is_valid = (tensordict[key] for key in astuple(self.tensor_keys))
        self._require(self.tensor_keys.is_valid, is_valid, None, chunk.shape[:-1])
        flow: ChunkNetwork = self.network("actor_network").module
        observation = [tensordict[key] for key in self._observation]
        noise = torch.randn(self.draws, *chunk.shape, dtype=chunk.dtype, device=chunk.device)
        time = torch.rand(noise.shape[:-2], dtype=chunk.dtype, device=chunk.device)
        noisy = torch.lerp(noise, chunk.expand_as(noise), time[..., None, None])
        parameters = self.actor_network_params["module"]
        with parameters.to_module(flow, preserve_module_state=False):
            features = flow.encoder(*observation)
            clean = flow.head(features.expand(self.draws, *features.shape), noisy, time)
        error = _mean_of_valid((clean - chunk).square().mean(-1), is_valid).mean(0)
        return TensorDict({"loss_flow": self._reduce_loss(error, tensordict)})


def _mean_of_valid(values: Tensor, is_valid: Tensor) -> Tensor:
    """Return the mean [..., B] of the values [..., B, T] that count; 0 if none does."""
    weight = is_valid.to(values.dtype)
    return (values * weight).sum(-1) / weight.sum(-1).clamp_min(1)
