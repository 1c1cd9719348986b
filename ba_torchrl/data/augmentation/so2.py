"""Rotation of sampled transitions, for algorithms that learn from turned copies."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor, nn

from ba_torchrl.envs import keys

_NEXT_PIXELS = (keys.NEXT, keys.PIXELS)


def quarters_and_rotation(angle_rad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return (quarter turns or -1 if not a whole number of them, cosine, sine) of angles [B].

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
    """Return images turned about their centres as the world turns about z.

    A quarter turn is ``torch.rot90(k=1)`` and exact; between, bilinear, and what comes in from
    outside repeats the border.

    Args:
        images: [B, C, H, H], rows along +x, columns along +y.
        angle_rad: [B] float64 on the CPU, radians.
    """
    quarters, cos, sin = quarters_and_rotation(angle_rad)
    # Where an output pixel comes from, in (column, row): the inverse rotation.
    zero = torch.zeros_like(cos)
    rows = [torch.stack([cos, -sin, zero], dim=-1), torch.stack([sin, cos, zero], dim=-1)]
    source = torch.stack(rows, dim=1).to(images)
    grid = F.affine_grid(source, list(images.shape), align_corners=False)
    turned = F.grid_sample(images, grid, padding_mode="border", align_corners=False)
    exact_quarters(turned, images, quarters)
    return turned


def exact_quarters(turned: Tensor, images: Tensor, quarters: Tensor) -> None:
    """Overwrite images that were turned by whole quarters with exact copies.

    Args:
        turned: [B, C, H, H], changed in place.
        images: before they were turned.
        quarters: int64 [B] on the CPU; -1 leaves an image as it is.
    """
    for k in sorted(set(quarters.tolist()) - {-1}):
        exact = (quarters == k).nonzero().squeeze(-1).to(images.device)
        turned[exact] = torch.rot90(images[exact], k, (-2, -1))


def rotate_displacement(displacement: Tensor, angle_rad: Tensor) -> Tensor:
    """Return (dx, dy) turned about z, shortened to the edge of [-1, 1]^2 where it leaves the box.

    The direction is kept, which clipping each component would not do.

    Args:
        displacement: [B, 2].
        angle_rad: [B] float64 on the CPU, radians.
    """
    _, cos, sin = (value.to(displacement.device) for value in quarters_and_rotation(angle_rad))
    cos, sin = cos.to(displacement.dtype), sin.to(displacement.dtype)
    dx, dy = displacement.unbind(dim=-1)
    turned = torch.stack([cos * dx - sin * dy, sin * dx + cos * dy], dim=-1)
    return turned / turned.abs().amax(dim=-1, keepdim=True).clamp_min(1)


class SO2Augmentation(nn.Module):
    """Turns image, next image and (dx, dy) of sampled transitions by one random angle each.

    It stands for the turned copies that the reference stores beside each transition (appendix
    G.2, "augmentation buffer"): four copies and the original are a probability of 0.8. Gripper,
    z and yaw components are unchanged. Call it again for another view.

    Args:
        action_sequence: one letter per action component; x and y are turned.
        seed: of the module's own draws.
        probability: of turning a transition.

    Raises:
        ValueError: the probability is outside [0, 1], or x or y is missing.
    """

    def __init__(self, action_sequence: str, *, seed: int, probability: float = 0.8) -> None:
        super().__init__()
        if not 0 <= probability <= 1:
            raise ValueError(f"probability must be in [0, 1], got {probability}")
        if not {"x", "y"} <= set(action_sequence):
            raise ValueError(f"nothing to turn in the action {action_sequence!r}: no x and y")
        self.probability = probability
        self._plane = [action_sequence.index("x"), action_sequence.index("y")]
        # On the CPU whatever the batch's device: the same seed turns the same way everywhere.
        self._generator = torch.Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return a batch of transitions [B] with some turned; the input is not changed.

        Args:
            tensordict: holds ``pixels``, ("next", "pixels") and ``action``.
        """
        (batch,) = tensordict.batch_size
        draws = torch.rand(2, batch, generator=self._generator, dtype=torch.float64)
        chosen = (draws[0] < self.probability).nonzero().squeeze(-1)
        angle = 2 * math.pi * draws[1, chosen]
        out = tensordict.copy()
        if not len(chosen):
            return out
        pixels, action = tensordict[keys.PIXELS], tensordict[keys.ACTION]
        index = chosen.to(pixels.device)
        # Both images as channels of one: they share the grid.
        images = torch.cat([pixels, tensordict[_NEXT_PIXELS]], dim=1)
        images[index] = rotate_images(images[index], angle)
        first, second = images.split(pixels.shape[1], dim=1)
        out.set(keys.PIXELS, first.contiguous()).set(_NEXT_PIXELS, second.contiguous())
        action = action.clone()
        rows = index[:, None]
        plane = torch.tensor(self._plane, device=action.device)
        action[rows, plane] = rotate_displacement(action[rows, plane], angle)
        return out.set(keys.ACTION, action)

    def get_extra_state(self) -> Tensor:
        """Return the generator's state, so that a checkpoint continues the same draws."""
        return self._generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Take over what ``get_extra_state`` returned."""
        self._generator.set_state(state.cpu())
