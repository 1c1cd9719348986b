"""Rotation of transitions about the z axis; the appendix has no augmentation of this kind."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import NoReturn

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Transform

from ba_torchrl.core import keys
from ba_torchrl.core.errors import BatchError, ConfigError, layout
from ba_torchrl.core.generators import seeded_generator
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.data.transfer import to_device


def quarters_and_rotation(angle_rad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return (number of quarter turns, -1 for other angles; cosine; sine) of angles [B].

    Cosine and sine are exact at quarter turns.
    """
    quarters = torch.round(angle_rad / (math.pi / 2))
    rest = angle_rad - quarters * (math.pi / 2)
    rest = torch.where(rest.abs() < 1e-9, 0.0, rest)
    quarters = quarters.long() % 4
    cos, sin = rest.cos(), rest.sin()
    for k in range(1, 4):
        cos, sin = torch.where(quarters >= k, -sin, cos), torch.where(quarters >= k, cos, sin)
    return torch.where(rest == 0, quarters, -1), cos, sin


def rotate_images(images: Tensor, angle_rad: Tensor) -> Tensor:
    """Return images rotated about their centres as the scene rotates about z.

    A quarter turn is ``torch.rot90(k=1)`` and exact; other angles are bilinear, and pixels from
    outside the image repeat its border.

    Args:
        images: [B, C, H, H], rows along +x, columns along +y.
        angle_rad: [B] float64 on the CPU, radians.
    """
    quarters, cos, sin = quarters_and_rotation(angle_rad)
    # Source of an output pixel in (column, row): the inverse rotation.
    zero = torch.zeros_like(cos)
    rows = [torch.stack([cos, -sin, zero], dim=-1), torch.stack([sin, cos, zero], dim=-1)]
    source = to_device(torch.stack(rows, dim=1).to(images.dtype), images.device)
    grid = F.affine_grid(source, list(images.shape), align_corners=False)
    rotated = F.grid_sample(images, grid, padding_mode="border", align_corners=False)
    copy_exact_quarters(rotated, images, quarters)
    return rotated


def copy_exact_quarters(rotated: Tensor, images: Tensor, quarters: Tensor) -> None:
    """Overwrite images that were rotated by whole quarter turns with exact copies.

    Args:
        rotated: [B, C, H, H], changed in place.
        images: before the rotation.
        quarters: int64 [B] on the CPU, number of quarter turns; -1 leaves an image unchanged.
    """
    for k in sorted(set(quarters.tolist()) - {-1}):
        exact = to_device((quarters == k).nonzero().squeeze(-1), images.device)
        rotated[exact] = torch.rot90(images[exact], k, (-2, -1))


def rotate_displacement(displacement: Tensor, angle_rad: Tensor) -> Tensor:
    """Return (dx, dy) rotated about z and, if it leaves [-1, 1]^2, scaled to its boundary.

    Scaling keeps the direction, which clipping of the components does not.

    Args:
        displacement: [B, 2], or chunks [B, T, 2].
        angle_rad: [B] float64 on the CPU, radians.
    """
    _, *rotation = quarters_and_rotation(angle_rad)
    of_rows = (-1, *[1] * (displacement.ndim - 2))
    cos, sin = (
        to_device(x.to(displacement.dtype), displacement.device).view(of_rows) for x in rotation
    )
    dx, dy = displacement.unbind(dim=-1)
    turned = torch.stack([cos * dx - sin * dy, sin * dx + cos * dy], dim=-1)
    return turned / turned.abs().amax(dim=-1, keepdim=True).clamp_min(1)


def image_pairs(images: Iterable[str]) -> list[NestedKey]:
    """Return the keys of images and next images."""
    return [nested for key in images for nested in (key, (keys.NEXT, key))]


def check_square(key: str, image: Tensor) -> None:
    """Raise `BatchError` unless images are [B, C, H, H]."""
    if image.ndim != 4 or image.shape[-1] != image.shape[-2]:
        found = layout(image.dtype, image.shape)
        raise BatchError(f"{key!r} is {found}, and must be square images [B, C, H, H]")


def map_pairs(
    tensordict: TensorDictBase, key: str, rows: Tensor, transform: Callable[[Tensor], Tensor]
) -> None:
    """Transform an image and the next image in some rows of a batch by one call.

    Args:
        tensordict: batch [B]; gets new tensors under ``key`` and ("next", ``key``).
        key: of the image.
        rows: int64 [R], on any device.
        transform: maps [R, 2 C, H, W], both images concatenated along the channels, to the same
            shape.
    """
    image = tensordict[key]
    check_square(key, image)
    if not image.is_floating_point():
        raise ConfigError(
            f"{key} holds codes, {image.dtype}: append the rotation after ImageCodecs"
        )
    images = torch.cat([image, tensordict[keys.NEXT, key]], dim=1)
    rows = to_device(rows, images.device)
    images[rows] = transform(images[rows])
    first, second = images.split(image.shape[1], dim=1)
    tensordict.set(key, first.contiguous()).set((keys.NEXT, key), second.contiguous())


def require_known_frames(images: Mapping[str, ImageSpec]) -> None:
    """Raise `ValueError` for an image whose frame is "camera", for which no rotation is defined."""
    unknown = [key for key, image in images.items() if image.frame == "camera"]
    if unknown:
        raise ValueError(
            f"rotation: {', '.join(unknown)} does not rotate with the scene and cannot be "
            "transformed; use rotation.name=none"
        )


class SeededTransform(Transform):
    """A transform of sampled transitions with draws of its own, for a replay.

    Its generator is a part of its state, which the replay saves, and on the CPU for any device of
    the batch, so that the draws of a seed are the same on all devices.

    Args:
        changed: keys of the entries that it changes; with those of the next observation.
        seed: of the draws.
    """

    def __init__(self, changed: Iterable[NestedKey], seed: int) -> None:
        changed = list(changed)
        super().__init__(changed, changed)
        self._generator = seeded_generator(seed)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> NoReturn:
        raise ConfigError(
            f"{type(self).__name__} transforms an image together with the next one: append it to a "
            "replay, not to an environment"
        )

    def _copied(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return a copy of transitions [B], whose entries can be replaced."""
        if tensordict.ndim != 1:
            raise ConfigError(
                f"{type(self).__name__} takes a batch of transitions [B], not "
                f"{list(tensordict.shape)}: flatten slices and episodes, reshape(-1), first"
            )
        return tensordict.copy()

    def get_extra_state(self) -> Tensor:
        """Return the generator's state, so that a checkpoint continues the same draws."""
        return self._generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator's state, from any device."""
        self._generator.set_state(state.cpu())


class SO2Augmentation(SeededTransform):
    """Rotates images, next images and (dx, dy) of each transition by a random angle.

    The reference implementation stores four rotated copies with each transition; on sampled
    transitions, a probability of 0.8 has nearly the same effect without the memory. The gripper, z
    and yaw components and images with the gripper's axes are unchanged, and so are vectors such as
    ``proprio``, which do not fit the rotated images. Each call on the same batch draws new angles.

    Args:
        images: declarations of the images by key.
        action_sequence: one letter per action component; x and y are rotated.
        seed: of the module's own draws.
        probability: of rotating a transition.

    Raises:
        ValueError: the probability is outside [0, 1], x or y is missing, the images are those of an
            open-loop task, or an image cannot be rotated.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ba_torchrl.core.images import ImageSpec
        >>> from ba_torchrl.data import SO2Augmentation
        >>> images = {"depth": ImageSpec(channels=1, size=64, high=0.4, storage="uint8")}
        >>> rotation = SO2Augmentation(images, "pxyzr", seed=0, probability=1.0)
        >>> def observed():
        ...     return {"depth": torch.rand(8, 1, 64, 64), "holding": torch.zeros(8, 1) > 0}
        >>> batch = {**observed(), "action": torch.rand(8, 5), "next": observed()}
        >>> batch = TensorDict(batch, [8])
        >>> rotated = rotation(batch)  # or replay.append_transform(rotation)
        >>> torch.equal(rotated["action"][:, [0, 3, 4]], batch["action"][:, [0, 3, 4]])
        True
    """

    def __init__(
        self,
        images: Mapping[str, ImageSpec],
        action_sequence: str,
        *,
        seed: int,
        probability: float = 0.8,
    ) -> None:
        if not 0 <= probability <= 1:
            raise ValueError(f"probability must be in [0, 1], got {probability}")
        if not {"x", "y"} <= set(action_sequence):
            raise ValueError(f"the action {action_sequence!r} has no x and y to rotate")
        if keys.HEIGHTMAP in images:
            raise ValueError("x and y of open-loop actions are positions: use RigidAugmentation")
        require_known_frames(images)
        scene_images = [key for key, image in images.items() if image.frame == "scene"]
        super().__init__([*image_pairs(scene_images), keys.ACTION], seed)
        self.probability = probability
        self._scene_images = scene_images
        self._plane = [action_sequence.index("x"), action_sequence.index("y")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return a copy of a batch of transitions [B] with some of them rotated.

        Args:
            tensordict: holds the images, their successors, ``action`` and, if they are there,
                ``target_action`` and ``target_chunk``.
        """
        out = self._copied(tensordict)
        draws = torch.rand(
            2, len(out), generator=self._generator, dtype=torch.float64, device="cpu"
        )
        chosen = (draws[0] < self.probability).nonzero().squeeze(-1)
        angle = 2 * math.pi * draws[1, chosen]
        if not len(chosen):
            return out
        for key in self._scene_images:
            map_pairs(out, key, chosen, lambda images: rotate_images(images, angle))
        for key in (keys.ACTION, keys.TARGET_ACTION, keys.TARGET_CHUNK):
            if key != keys.ACTION and key not in tensordict:
                continue
            action = tensordict[key].clone()
            rows = to_device(chosen, action.device)
            plane = to_device(torch.tensor(self._plane, device="cpu"), action.device)
            turned = rotate_displacement(action[rows].index_select(-1, plane), angle)
            action[rows] = action[rows].index_copy(-1, plane, turned)
            out.set(key, action)
        return out


class StoredCopies(Transform):
    """Adds augmented copies after each transition that enters a replay.

    The reference implementation stores four rotated copies. They take five times the capacity and,
    in a prioritised replay, each copy has a priority of its own.

    Args:
        transform: augmentation of a batch of transitions.
        copies: number of copies of each transition.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from ba_torchrl.core.images import ImageSpec
        >>> from ba_torchrl.data import SO2Augmentation, StoredCopies
        >>> images = {"depth": ImageSpec(channels=1, size=64, high=0.4, storage="uint8")}
        >>> copies = StoredCopies(SO2Augmentation(images, "pxyzr", seed=0), copies=4)
        >>> replay = TensorDictReplayBuffer(storage=LazyTensorStorage(100), transform=copies)
        >>> def observed():
        ...     return {"depth": torch.rand(8, 1, 64, 64), "holding": torch.zeros(8, 1) > 0}
        >>> batch = {**observed(), "action": torch.rand(8, 5), "next": observed()}
        >>> batch = TensorDict(batch, [8])
        >>> index = replay.extend(batch)
        >>> len(replay)
        40
    """

    def __init__(self, transform: Transform, copies: int) -> None:
        super().__init__()
        self.transform = transform
        self.copies = copies

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return sampled transitions as they are."""
        return tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return transitions [N] as [N (copies + 1)], each followed by its copies."""
        copies = [self.transform(tensordict) for _ in range(self.copies)]
        return torch.stack([tensordict, *copies], dim=1).flatten(0, 1)
