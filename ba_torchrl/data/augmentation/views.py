"""Random views of images: crops and shifts (RAD, DrQ, CURL)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Transform

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.data.augmentation.so2 import SeededTransform, check_square, image_pairs
from ba_torchrl.data.replay.codecs import mapped_bounds
from ba_torchrl.data.transfer import to_device


def take_views(images: Tensor, offsets: Tensor, size: int, padding: int = 0) -> Tensor:
    """Return square parts of images, whose border is repeated outside of them.

    Args:
        images: [B, C, H, W].
        offsets: int64 [B, V, 2], row and column of each view's first pixel in the padded image.
        size: rows and columns of a view, pixels.
        padding: rows and columns added on each side of the images, pixels.

    Returns:
        [B, V, C, size, size].
    """
    height, width = images.shape[-2:]
    steps = torch.arange(size, device=images.device) - padding
    rows = (offsets[..., 0, None] + steps).clamp(0, height - 1)[..., :, None]
    columns = (offsets[..., 1, None] + steps).clamp(0, width - 1)[..., None, :]
    batch = torch.arange(len(images), device=images.device).reshape(-1, 1, 1, 1)
    return images.movedim(1, -1)[batch, rows, columns].movedim(-1, 2)


class CenterCrop(Transform):
    """The central part of images, which the acting policy sees; needs no torchvision.

    Args:
        size: rows and columns, pixels.
        in_keys: images [..., H, W].
        out_keys: their parts [..., size, size]; None to replace the images.

    Raises:
        ConfigError: at the first image that is smaller than its part.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from ba_torchrl import make
        >>> from ba_torchrl.data import CenterCrop
        >>> env = make("close_loop/block_reaching", obs_size=76)
        >>> env = TransformedEnv(env, CenterCrop(64, in_keys=["depth"]))
        >>> env.reset()["depth"].shape
        torch.Size([1, 64, 64])
        >>> env.close()
    """

    def __init__(
        self,
        size: int,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(in_keys, in_keys if out_keys is None else out_keys)
        self.size = size

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Return the specification with the sizes of the central parts."""
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            observation_spec[out_key] = mapped_bounds(observation_spec[key], self._apply_transform)
        return observation_spec

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _apply_transform(self, images: Tensor) -> Tensor:
        if min(images.shape[-2:]) < self.size:
            raise ConfigError(
                f"images of {list(images.shape[-2:])} px have no centre of {self.size} px"
            )
        row, column = ((length - self.size) // 2 for length in images.shape[-2:])
        return images[..., row : row + self.size, column : column + self.size]


def cropped_images(images: Mapping[str, ImageSpec], size: int) -> dict[str, ImageSpec]:
    """Return the declarations of the views of images.

    Args:
        images: declarations by key.
        size: rows and columns of the views, pixels.

    Raises:
        ConfigError: an image is not larger than its views, which would all be the same.
    """
    for key, image in images.items():
        if image.size <= size:
            raise ConfigError(
                f"views.size={size}: image {key!r} has only {image.size} px, and random crops are "
                "smaller than the image (appendix: 128 of 142 px); raise env.obs_size or lower "
                "algorithm.views.size"
            )
    return {key: replace(image, size=size) for key, image in images.items()}


class RandomViews(SeededTransform):
    """Shifts or crops the images of sampled transitions at random.

    With one view of the image and one of the next image, both have the same offset (RAD: Laskin et
    al., "Reinforcement Learning with Augmented Data", 2020). With several, every view has its own
    offset, and observation or next observation get a dimension of views after the batch (DrQ:
    Kostrikov et al., "Image Augmentation Is All You Need", 2021). No other entry changes: the
    holding flag and the vectors of a view are those of the transition.

    Args:
        images: declarations of the images by key.
        vectors: keys of the other entries of the observation besides the holding flag.
        size: rows and columns of a view, pixels; None for those of the image.
        padding: pixels added on each side of an image, which repeat its border.
        views: number of views of the image.
        target_views: number of views of the next image.
        has_positive: add one more view of the image, under "positive", for a contrastive loss
            (CURL: Srinivas et al., 2020).
        seed: of the module's own draws.

    Raises:
        ValueError: a number of views is not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ba_torchrl.core.images import ImageSpec
        >>> from ba_torchrl.data import RandomViews
        >>> images = {"depth": ImageSpec(channels=1, size=64, high=0.4, storage="uint8")}
        >>> views = RandomViews(images, seed=0, padding=4, views=2)
        >>> def observed():
        ...     return {"depth": torch.rand(8, 1, 64, 64), "holding": torch.zeros(8, 1) > 0}
        >>> batch = {**observed(), "action": torch.rand(8, 5), "next": observed()}
        >>> batch = TensorDict(batch, [8])
        >>> seen = views(batch)  # or replay.append_transform(views)
        >>> seen["depth"].shape, seen["next", "depth"].shape
        (torch.Size([8, 2, 1, 64, 64]), torch.Size([8, 1, 64, 64]))
    """

    def __init__(
        self,
        images: Mapping[str, ImageSpec],
        vectors: Iterable[str] = (),
        *,
        seed: int,
        size: int | None = None,
        padding: int = 0,
        views: int = 1,
        target_views: int = 1,
        has_positive: bool = False,
    ) -> None:
        others = [keys.HOLDING, *vectors]
        changed = image_pairs([*images, *others])
        super().__init__(changed, seed)
        if min(views, target_views) < 1:
            raise ValueError(f"views must be positive, got {views} and {target_views}")
        self.sizes = {key: image.size if size is None else size for key, image in images.items()}
        self.others = others
        """Keys of the entries of the observation that are the same in all views."""
        self.padding = padding
        self.views = views
        self.target_views = target_views
        self.has_positive = has_positive

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return a copy of a batch of transitions [B] with views of the images.

        Args:
            tensordict: holds the images, the holding flag and their successors.
        """
        out = self._copied(tensordict)
        is_paired = self.views == self.target_views == 1
        for key in self.sizes:
            image, following = tensordict[key], tensordict[keys.NEXT, key]
            check_square(key, image)
            offsets = self._draw(key, image, self.views)
            out.set(key, self._take(key, image, offsets))
            if not is_paired:
                offsets = self._draw(key, image, self.target_views)
            out.set((keys.NEXT, key), self._take(key, following, offsets))
            if self.has_positive:
                positive = self._take(key, image, self._draw(key, image, 1))
                out.set((keys.POSITIVE, key), positive)
        for key in self.others:
            value, following = tensordict[key], tensordict[keys.NEXT, key]
            if self.has_positive:
                out.set((keys.POSITIVE, key), value)
            if self.views > 1:
                out.set(key, value[:, None].expand(-1, self.views, -1))
            if self.target_views > 1:
                expanded = following[:, None].expand(-1, self.target_views, -1)
                out.set((keys.NEXT, key), expanded)
        return out

    def _draw(self, key: str, image: Tensor, views: int) -> Tensor:
        """Return uniform offsets [B, views, 2]."""
        choices = image.shape[-1] + 2 * self.padding - self.sizes[key] + 1
        offsets = torch.randint(
            choices, (len(image), views, 2), generator=self._generator, device="cpu"
        )
        return to_device(offsets, image.device)

    def _take(self, key: str, image: Tensor, offsets: Tensor) -> Tensor:
        """Return [B, C, size, size] of a single view, and [B, V, C, size, size] of several."""
        views = take_views(image, offsets, self.sizes[key], self.padding)
        return views.squeeze(1) if offsets.shape[1] == 1 else views
