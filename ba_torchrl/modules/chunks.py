"""Action chunks: a network from an observation and noise to the next actions, by flow matching."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from ba_torchrl.core import keys
from ba_torchrl.core.errors import BatchError, layout
from ba_torchrl.core.evaluation_mode import evaluation_copy
from ba_torchrl.core.generators import seeded_generator
from ba_torchrl.modules.base import ActorCritic, ActorCriticSpec, Frames

_FREQUENCIES = 8
_FASTEST = 50.0
_NOISES = 128
_CARRIED_CHUNK = (keys.CARRIED, keys.ACTION_CHUNK)


class ChunkHead(nn.Module):
    """The clean chunk that a noisy chunk belongs to, predicted from features of the observation.

    One network is applied for each element of a group, to the features of this element and to the
    chunk turned into the element's frame; the result is the mean of the outputs, turned back
    (Wang et al., "Equivariant Diffusion Policy", 2024). With features that are equivariant, so is
    the chunk. A group of one element makes a network without symmetry.

    Args:
        fields: number of features of an element.
        frames: representation of the group on the action, [G, A, A], in the order of a feature's
            components.
        vector_frames: representation on the vectors that follow the features, [G, V, V].
        horizon: number T of actions in a chunk.
        hidden: units of both hidden layers.
    """

    frames: Tensor
    vector_frames: Tensor

    def __init__(
        self, fields: int, frames: Tensor, vector_frames: Tensor, horizon: int, hidden: int = 256
    ) -> None:
        super().__init__()
        self.fields, self.horizon = fields, horizon
        self.register_buffer("frames", frames, persistent=False)
        self.register_buffer("vector_frames", vector_frames, persistent=False)
        size = horizon * frames.shape[-1]
        inputs = fields + vector_frames.shape[-1] + size + 2 * _FREQUENCIES
        self.layers = nn.Sequential(
            nn.Linear(inputs, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, size),
        )

    def forward(self, features: Tensor, chunk: Tensor, time: Tensor) -> Tensor:
        """Return the clean chunk [..., T, A].

        Args:
            features: [..., fields * G + V].
            chunk: noisy, [..., T, A].
            time: from 0, noise, to 1, no noise, [...].
        """
        group, size = self.frames.shape[:2]
        wanted = [self.horizon, size]
        if list(chunk.shape[-2:]) != wanted or chunk.dtype != self.frames.dtype:
            raise BatchError(
                f"a chunk is {layout(chunk.dtype, chunk.shape)}, and must be "
                f"{layout(self.frames.dtype, wanted)} for each sample: horizon, action"
            )
        vectors = self.vector_frames.shape[-1]
        image, vector = features.split([self.fields * group, vectors], dim=-1)
        image = F.layer_norm(image, image.shape[-1:])
        image = image.unflatten(-1, (self.fields, group)).transpose(-1, -2)
        turned = torch.einsum("gba,...tb->...gta", self.frames, chunk).flatten(-2)
        vector = torch.einsum("gba,...b->...ga", self.vector_frames, vector)
        encoded = encoded_time(time)[..., None, :].expand(*turned.shape[:-1], -1)
        out = self.layers(torch.cat([image, vector, turned, encoded], dim=-1))
        out = out.unflatten(-1, (self.horizon, size))
        return torch.einsum("gab,...gtb->...ta", self.frames, out) / group


def chunk_head(
    networks: ActorCritic, spec: ActorCriticSpec, horizon: int, hidden: int = 256
) -> ChunkHead:
    """Return a head for the features of an actor-critic network's encoder.

    Args:
        networks: freshly built. With `ActorCritic.frames` of a group, the head is equivariant as
            the encoder is.
        spec: for which they were built.
        horizon: number of actions in a chunk.
        hidden: units of both hidden layers.
    """
    images = [image.to_tensor_spec().zero()[None] for image in spec.images.values()]
    holding = torch.zeros(1, 1, dtype=torch.bool, device="cpu")
    vectors = [
        torch.zeros(1, size, dtype=torch.float32, device="cpu") for size in spec.vectors.values()
    ]
    with torch.no_grad():
        features = evaluation_copy(networks.encoder)(*images, holding, *vectors)
    frames = networks.frames or Frames.without_symmetry(replace(spec, vectors={}))
    fields = (features.shape[-1] - frames.vectors.shape[-1]) // len(frames.action)
    return ChunkHead(fields, *frames, horizon, hidden)


def encoded_time(time: Tensor) -> Tensor:
    """Return sines and cosines [..., 16] of times [...] in [0, 1], with frequencies up to 50."""
    steps = torch.linspace(
        0, math.log(_FASTEST), _FREQUENCIES, dtype=time.dtype, device=time.device
    )
    angles = time[..., None] * steps.exp()
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class ChunkFlow(nn.Module):
    """The next actions, drawn by an ordinary differential equation that starts from noise.

    Rectified flow (Liu et al., "Flow Straight and Fast", 2022): a chunk x moves along a straight
    line from noise at time 0 to a chunk of the data at time 1. The head predicts the end of the
    line, which gives the velocity (end - x) / (1 - time); Euler's method follows it.

    Args:
        encoder: from the observation to features [..., F].
        head: from features, noisy chunk and time to the clean chunk.
        steps: of Euler's method.
    """

    def __init__(self, encoder: nn.Module, head: ChunkHead, steps: int = 8) -> None:
        super().__init__()
        self.encoder = encoder
        self.head = head
        self.steps = steps

    def forward(self, *observation_and_noise: Tensor) -> Tensor:
        """Return the chunk [..., T, A] in [-1, 1] of the observation's entries and, last, the noise
        [..., T, A]."""
        *observation, chunk = observation_and_noise
        features = self.encoder(*observation)
        for step in range(self.steps):
            time = chunk.new_full(chunk.shape[:-2], step / self.steps)
            chunk = chunk + (self.head(features, chunk, time) - chunk) / (self.steps - step)
        return chunk.clamp(-1, 1)


class ChunkPolicy(TensorDictModuleBase):
    """A policy that executes the first actions of a chunk, and then draws the next chunk.

    The actions that are left are in the TensorDict, under ("carried", "action_chunk"), so that each
    environment of a vector has its own: pass the entry on to the next step, as TorchRL's rollouts
    and collectors do. Without it, the policy draws a new chunk. A chunk begins where ``step_count``
    is a multiple of ``executed``, so at the first step of each episode. TorchRL's
    ``MultiStepActorWrapper`` counts by itself, needs an ``InitTracker``, and acts on the rows
    that begin a chunk alone: with another batch size, a network computes other last bits.

    Under TorchRL's exploration type RANDOM the noise is drawn; otherwise it is the same in each
    episode, so that a row's action does not depend on other rows.

    Args:
        flow: reads the observation and, last, the noise.
        action_size: number of components of an action.
        executed: number of actions of a chunk that are executed.
        seed: of the drawn noise.
    """

    noise: Tensor

    def __init__(
        self,
        flow: ChunkFlow,
        in_keys: Sequence[NestedKey],
        action_size: int,
        executed: int,
        seed: int,
    ) -> None:
        super().__init__()
        horizon = flow.head.horizon
        if not 1 <= executed <= horizon:
            raise ValueError(f"executed must be between 1 and {horizon}, got {executed}")
        shape = (_NOISES, horizon, action_size)
        noise = torch.randn(shape, generator=seeded_generator(0), dtype=torch.float32, device="cpu")
        self.register_buffer("noise", noise, persistent=False)
        self.flow = TensorDictModule(flow, [*in_keys, keys.NOISE], [keys.ACTION_CHUNK])
        self.in_keys = [*in_keys, keys.STEP_COUNT]
        self.out_keys = [keys.ACTION, _CARRIED_CHUNK]
        self.executed = executed
        self.generator = seeded_generator(seed)

    @torch.no_grad()  # else each chunk that is carried on would hold the graphs of all before it
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` and ("carried", "action_chunk"), whose first action it is.

        Args:
            tensordict: observation with ``step_count``, and perhaps what the policy wrote at the
                step before; of any batch shape.
        """
        count = tensordict[keys.STEP_COUNT]
        begins = (count % self.executed == 0)[..., None]
        chunk = tensordict.get(_CARRIED_CHUNK, None)
        if chunk is not None:
            chunk = torch.cat([chunk[..., 1:, :], chunk[..., -1:, :]], dim=-2)
        # compiled and exported code has no branch that depends on values
        if chunk is None or torch.compiler.is_compiling() or bool(begins.any()):
            seen = tensordict.select(*self.in_keys).set(keys.NOISE, self._noise(count.squeeze(-1)))
            new = self.flow(seen)[keys.ACTION_CHUNK]
            chunk = new if chunk is None else torch.where(begins, new, chunk)
        return tensordict.set(_CARRIED_CHUNK, chunk).set(keys.ACTION, chunk[..., 0, :])

    def _noise(self, count: Tensor) -> Tensor:
        if exploration_type() is not ExplorationType.RANDOM:
            # an index without dimensions would be read as a number, which no export can trace
            noise = F.embedding(count % len(self.noise), self.noise.flatten(1))
            return noise.unflatten(-1, self.noise.shape[1:])
        shape = (*count.shape, *self.noise.shape[1:])
        drawn = torch.randn(shape, generator=self.generator, dtype=torch.float32, device="cpu")
        return drawn.to(self.noise)
