"""Replays, by how a batch is drawn (appendix G.1, G.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from ba_torchrl.core.choices import WeightedTerms, WeightNorm
from ba_torchrl.core.config import Part

if TYPE_CHECKING:
    import torch

    from ba_torchrl.core.images import ImageSpec
    from ba_torchrl.data.replay.buffer import FrameReplayBuffer


class _Replay(Part):
    least_batch: ClassVar[int] = 1
    """Least number of transitions in a batch."""

    capacity: int = Field(default=100_000, ge=1, le=100_000_000)
    """Transitions, demonstrations and others together."""

    @property
    def loss_options(self) -> dict[str, Any]:
        """Arguments of a loss."""
        return {}

    def build(
        self, batch_size: int, images: Mapping[str, ImageSpec], seed: int, device: torch.device
    ) -> FrameReplayBuffer:
        """Return an empty replay, whose samples have decoded images on a device.

        Args:
            batch_size: of a sample.
            images: declarations of the stored images.
            seed: of the draws.
            device: of the images; the codes are copied to it.
        """
        from ba_torchrl.data.replay.codecs import ImageCodecs, make_codecs
        from ba_torchrl.data.replay.make import make_replay

        own = self.model_dump(exclude={"name", "capacity", *self.loss_options})
        own |= {"codecs": make_codecs(images), "returns_codes": device.type != "cpu", "seed": seed}
        replay = make_replay(self.name, self.capacity, batch_size, **own)
        if device.type != "cpu":
            replay.append_transform(ImageCodecs(images, device=device))
        return replay


class Uniform(_Replay):
    """Transitions are drawn uniformly."""

    name: Literal["uniform"] = "uniform"


class Prioritized(_Replay):
    """Transitions are drawn by their TD error, with a bonus for demonstrations."""

    name: Literal["prioritized"] = "prioritized"
    priority_exponent: float = Field(default=0.6, ge=0)
    """Exponent alpha of the priorities."""
    importance_exponent: float = Field(default=0.4, ge=0, le=1)
    """Initial exponent beta of the importance weights, which increases to 1 over the run; with 0,
    the weights are 1 throughout."""
    weighted_terms: WeightedTerms = "none"
    """Terms of the loss that the importance weights multiply: "none", "critic",
    "critic_and_policy", or "all", which adds the terms of demonstrations and temperature. The
    appendix does not say; the reference implementation computes weights and does not use them."""
    weight_norm: WeightNorm = "max"
    """Statistic of a batch by which its importance weights are divided: "max", as in Schaul et al.
    (2016), or "mean", for the weighted mean of TorchRL's losses."""
    expert_bonus: float = Field(default=1.0, ge=0)
    """Added to the priority of demonstrations."""

    @property
    def loss_options(self) -> dict[str, Any]:
        return {"weighted_terms": self.weighted_terms, "weight_norm": self.weight_norm}


class Symmetric(_Replay):
    """Half of a batch is drawn from the demonstrations and half from the other transitions."""

    name: Literal["symmetric"] = "symmetric"
    least_batch: ClassVar[int] = 2


Replay = Annotated[Uniform | Prioritized | Symmetric, Field(discriminator="name")]
