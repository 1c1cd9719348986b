"""Codecs of images in the replay, and the transform that applies them elsewhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded, Composite
from torchrl.envs import Transform

from ba_torchrl.core import keys
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.data.transfer import to_device


class ImageCodec(Protocol):
    """Maps images to uint8 codes and back; equal images have equal codes.

    Called as a module, it encodes and decodes an image.
    """

    def encode(self, image: Tensor) -> Tensor:
        """Return uint8 codes with the same leading dimensions."""
        ...

    def decode(self, codes: Tensor) -> Tensor:
        """Return the images of codes."""
        ...

    def __call__(self, image: Tensor) -> Tensor:
        """Return the decoded code of an image, in the image's type."""
        ...


def make_codecs(images: Mapping[str, ImageSpec]) -> dict[str, ImageCodec]:
    """Return the codec that each image's declaration specifies, by key.

    Raises:
        ValueError: an image has values that its storage cannot represent.

    Examples:
        >>> import torch
        >>> from ba_torchrl.core.images import ImageSpec
        >>> from ba_torchrl.data import make_codecs
        >>> images = {"depth": ImageSpec(channels=1, size=64, high=0.4, storage="uint8")}
        >>> codec = make_codecs(images)["depth"]
        >>> codec.encode(torch.tensor([0.1, 0.3]))
        tensor([ 64, 191], dtype=torch.uint8)
    """
    return {key: _make_codec(key, image) for key, image in images.items()}


def _make_codec(key: str, image: ImageSpec) -> ImageCodec:
    if image.storage == "exact":
        if image.dtype != torch.uint8:
            raise ValueError(
                f"image {key!r}: storage 'exact' takes uint8 images, not {image.dtype}"
            )
        return Uint8Images()
    if image.storage == "float16":
        return HalfPrecision(image.high)
    if image.low < 0:
        raise ValueError(
            f"image {key!r}: storage 'uint8' takes values from zero, not from {image.low:g}"
        )
    return DepthQuantizer(image.high)


def mapped_bounds(spec: Bounded, transform: Callable[[Tensor], Tensor]) -> Bounded:
    """Return the specification of transformed images, whose values keep their order."""
    low, high = transform(spec.space.low), transform(spec.space.high)
    return Bounded(low, high, dtype=low.dtype, device=spec.device)


class ImageCodecs(Transform):
    """Rounds images as the replay does, so that a policy sees in acting what it learns from.

    It works in a `TransformedEnv`, in a replay (where it rounds next images too), and called on an
    observation. Codes are decoded.

    Args:
        images: declarations by key.
        in_keys_inv: images that a replay encodes when it is extended. A `FrameStorage` encodes
            them itself.
        device: to which images are copied before they are decoded; None to leave them where they
            are.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from ba_torchrl.core.images import ImageSpec
        >>> from ba_torchrl.data import ImageCodecs
        >>> images = {"depth": ImageSpec(channels=1, size=64, high=0.4, storage="uint8")}
        >>> codecs = ImageCodecs(images, in_keys_inv=["depth"])
        >>> replay = TensorDictReplayBuffer(storage=LazyTensorStorage(100), transform=codecs)
        >>> index = replay.extend(TensorDict({"depth": torch.full((8, 1, 64, 64), 0.3)}, [8]))
        >>> replay.storage[:]["depth"].dtype, replay.sample(4)["depth"].dtype
        (torch.uint8, torch.float32)
    """

    def __init__(
        self,
        images: Mapping[str, ImageSpec],
        in_keys_inv: Sequence[str] = (),
        device: torch.device | None = None,
    ) -> None:
        super().__init__(list(images), list(images), list(in_keys_inv), list(in_keys_inv))
        self.codecs = make_codecs(images)
        self.device = device

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Round images, and next images if there are any, as the replay does."""
        if self.device is not None:
            tensordict.clear_device_()
        return self._map(tensordict, self.in_keys, self._stored)

    _call = forward

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _stored(self, codec: ImageCodec, image: Tensor) -> Tensor:
        if self.device is not None:
            image = to_device(image, self.device)
        return codec.decode(image) if image.dtype == torch.uint8 else codec(image)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._map(tensordict, self.in_keys_inv, lambda codec, image: codec.encode(image))

    def _map(
        self,
        tensordict: TensorDictBase,
        chosen: Sequence[str],
        function: Callable[[ImageCodec, Tensor], Tensor],
    ) -> TensorDictBase:
        for key in chosen:
            for nested in (key, (keys.NEXT, key)):
                if nested == key or nested in tensordict.keys(True):
                    tensordict.set(nested, function(self.codecs[key], tensordict[nested]))
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Return the specification with the bounds of stored images."""
        for key in self.in_keys:
            observation_spec[key] = mapped_bounds(observation_spec[key], self.codecs[key])
        return observation_spec


class Uint8Images(nn.Module):
    """The identity codec of uint8 images."""

    def encode(self, image: Tensor) -> Tensor:
        """Return the image.

        Raises:
            TypeError: the image is not uint8.
        """
        if image.dtype != torch.uint8:
            raise TypeError(f"the image must be uint8, got {image.dtype}")
        return image.contiguous()

    def decode(self, codes: Tensor) -> Tensor:
        """Return the codes, which are the image."""
        return codes

    def forward(self, image: Tensor) -> Tensor:
        """Return the image."""
        return image


class DepthQuantizer(nn.Module):
    """Depth images as uint8, in 255 equal steps over [0, high_m].

    Depth outside the range is clipped. Zero, the value of the fingers, is exact.

    Args:
        high_m: largest depth, metres.

    Raises:
        ValueError: ``high_m`` is not positive.
    """

    def __init__(self, high_m: float) -> None:
        super().__init__()
        if not high_m > 0:
            raise ValueError(f"high_m must be positive, got {high_m}")
        self.high_m = float(high_m)

    @property
    def step_m(self) -> float:
        """Quantisation step, metres."""
        return self.high_m / 255

    @property
    def max_error_m(self) -> float:
        """Largest error of a depth within the range: half a step, metres."""
        return self.step_m / 2

    def encode(self, depth: Tensor) -> Tensor:
        """Return uint8 codes of depth in metres, of any shape and floating type.

        Args:
            depth: metres.

        Raises:
            TypeError: the depth is not of a floating type.
        """
        if not depth.is_floating_point():
            raise TypeError(f"depth must be floating point metres, got {depth.dtype}")
        codes = depth.float().clamp(0, self.high_m) * (255 / self.high_m)
        # Not round(), which starts torch's threads even for one small image. That takes ten
        # milliseconds while environments or updates use all cores.
        return codes.add_(0.5).to(torch.uint8)

    def decode(self, codes: Tensor) -> Tensor:
        """Return float32 metres of uint8 codes of any shape."""
        return codes.to(torch.float32).mul_(self.step_m)

    def forward(self, depth: Tensor) -> Tensor:
        """Return the quantised depth, in the type of the input."""
        return self.decode(self.encode(depth)).to(depth.dtype)

    def extra_repr(self) -> str:
        """Return the range for ``print``."""
        return f"high_m={self.high_m}"


class HalfPrecision(nn.Module):
    """Heights as float16: two bytes each, with a relative error of at most 1/2048.

    Args:
        high_m: largest height, metres.

    Raises:
        ValueError: ``high_m`` is not positive, or beyond what float16 can hold.
    """

    def __init__(self, high_m: float) -> None:
        super().__init__()
        if not 0 < high_m <= torch.finfo(torch.float16).max:
            raise ValueError(f"high_m must be positive and finite in float16, got {high_m}")
        self.high_m = float(high_m)

    @property
    def max_error_m(self) -> float:
        """Largest error of a height within the range: half the spacing there, metres."""
        return 2.0 ** (math.frexp(math.nextafter(self.high_m, 0.0))[1] - 12)

    def encode(self, image: Tensor) -> Tensor:
        """Return heights [..., W] of a floating type as bytes [..., 2 W].

        Raises:
            TypeError: the heights are not of a floating type.
        """
        if not image.is_floating_point():
            raise TypeError(f"heights must be floating point metres, got {image.dtype}")
        return image.half().contiguous().view(torch.uint8)

    def decode(self, codes: Tensor) -> Tensor:
        """Return bytes [..., 2 W] as float32 heights [..., W]."""
        return codes.view(torch.float16).float()

    def forward(self, image: Tensor) -> Tensor:
        """Return the heights rounded to float16, in the type of the input."""
        return image.half().to(image.dtype)

    def extra_repr(self) -> str:
        """Return the range for ``print``."""
        return f"high_m={self.high_m}"
