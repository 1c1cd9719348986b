"""Rigid motions of sampled open-loop transitions: heightmaps, and where the action goes."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor, nn

from ba_torchrl.actions import OpenLoopActions
from ba_torchrl.data.augmentation.so2 import exact_quarters, quarters_and_rotation
from ba_torchrl.envs import keys

RigidMotions = Literal["none", "translation", "cn", "d4", "se2"]
"""Shifts; rotations of C_n; quarter turns and mirror images; rotations by any angle with shifts."""

SHIFT_SHARE = 0.05
"""Standard deviation of a shift, as a share of the workspace's side."""
ATTEMPTS = 10
"""Motions drawn for a transition until its action stays within the workspace."""

_NEXT_PIXELS = (keys.NEXT, keys.PIXELS)
_IN_HAND_KEYS = (keys.IN_HAND, (keys.NEXT, keys.IN_HAND))
_IN_HAND_AXES = {1: ("xy",), 3: ("yz", "xz", "xy")}
"""Axes of the gripper along rows and columns of each channel, by the number of channels."""


class Motion(NamedTuple):
    """Rigid motions of the plane about the workspace's centre: mirror y, turn, shift."""

    mirrored: Tensor
    """bool [B]."""
    angle_rad: Tensor
    """float64 [B]."""
    shift: Tensor
    """float64 [B, 2] of x and y, in sides of the workspace."""


def move_images(images: Tensor, motion: Motion) -> Tensor:
    """Return images moved as the world moves; what comes in from outside is zero.

    Quarter turns and mirror images without a shift are exact, the others bilinear.

    Args:
        images: [B, C, H, H], rows along +x, columns along +y.
        motion: of B images.
    """
    quarters, cos, sin = quarters_and_rotation(motion.angle_rad)
    sign = torch.where(motion.mirrored, -1.0, 1.0).to(cos)
    tx, ty = (2 * motion.shift).unbind(-1)
    # Where an output pixel comes from, in (column, row): shift, turn and mirror undone.
    rows = [
        torch.stack([sign * cos, -sign * sin, sign * (sin * tx - cos * ty)], dim=-1),
        torch.stack([sin, cos, -cos * tx - sin * ty], dim=-1),
    ]
    grid = F.affine_grid(torch.stack(rows, dim=1).to(images), list(images.shape), False)
    moved = F.grid_sample(images, grid, padding_mode="zeros", align_corners=False)
    still = (motion.shift == 0).all(dim=-1)
    for flip in (False, True):
        chosen = torch.where(still & (motion.mirrored == flip), quarters, -1)
        exact_quarters(moved, images.flip(-1) if flip else images, chosen)
    return moved


def reverse_in_hand(images: Tensor, axes: str) -> Tensor:
    """Return in-hand images with some axes of the gripper reversed.

    Exact for heights; to a voxel for the three projections, whose smoothing leans to one side.

    Args:
        images: [B, C, h, w], C = 1 for heights, 3 for projections.
        axes: "x", along which the fingers close, "y" across, or both.
    """
    channels = []
    for channel, names in zip(images.unbind(1), _IN_HAND_AXES[images.shape[1]], strict=True):
        channels.append(channel.flip([dim for dim in (-2, -1) if names[dim] in axes]))
    return torch.stack(channels, dim=1)


class RigidAugmentation(nn.Module):
    """Moves heightmap, next heightmap and action of sampled transitions by one random motion.

    The in-hand image lies in the gripper's frame: it stays, but for mirror images, and where a
    yaw comes back into half a turn, which turns the gripper over. A transition for which no motion
    was found that leaves its action within the workspace stays as it is.

    Args:
        motions: which, see `RigidMotions`.
        actions: the environment's action vector.
        seed: of the module's own draws.
        probability: of moving a transition.
        order: n of C_n.

    Raises:
        ValueError: the probability is outside [0, 1], the order is not positive, or the motions
            turn and the action has no yaw, or has tilts.
    """

    def __init__(
        self,
        motions: RigidMotions,
        actions: OpenLoopActions,
        *,
        seed: int,
        probability: float = 1.0,
        order: int = 16,
    ) -> None:
        super().__init__()
        if not 0 <= probability <= 1 or order < 1:
            raise ValueError(
                f"probability must be in [0, 1] and order positive, got {probability}, {order}"
            )
        if motions not in ("none", "translation"):
            if "rz" not in actions.components:
                raise ValueError(
                    f"augmentation {motions!r} turns the scene, and the action "
                    f"{actions.sequence!r} has no yaw to turn with it; use 'translation'"
                )
            if motions == "d4" and {"ry", "rx"} & set(actions.components):
                raise ValueError("augmentation 'd4' mirrors the scene, which tilts do not follow")
        self.motions = motions
        self.actions = actions
        self.probability = probability
        self.order = order
        # On the CPU whatever the batch's device: the same seed moves the same way everywhere.
        self._generator = torch.Generator().manual_seed(seed)
        self._xy = [actions.components.index(name) for name in "xy"]
        bounds = torch.tensor(actions.bounds_m[:2], dtype=torch.float64)
        self._center, self._side = bounds.mean(dim=1), bounds[:, 1] - bounds[:, 0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return a batch of transitions [B] with some moved; the input is not changed.

        Args:
            tensordict: holds ``pixels``, ``in_hand``, ``action`` and their successors.
        """
        out = tensordict.copy()
        if self.motions == "none":
            return out
        device = tensordict[keys.ACTION].device
        action = tensordict[keys.ACTION].cpu()
        (count,) = tensordict.batch_size
        wanted = torch.rand(count, generator=self._generator) < self.probability
        motion = self._draw(count)
        found = wanted & self._stays_inside(action, motion)
        for _ in range(ATTEMPTS - 1):
            again = self._draw(count)
            fits = wanted & ~found & self._stays_inside(action, again)
            motion = Motion(
                *(
                    torch.where(fits.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                    for new, old in zip(again, motion, strict=True)
                )
            )
            found |= fits
        if not found.any():
            return out
        rows = found.nonzero().squeeze(-1)
        motion = Motion(*(part[rows] for part in motion))
        index = rows.to(device)
        # Both images as channels of one: they share the grid.
        pixels = tensordict[keys.PIXELS]
        images = torch.cat([pixels, tensordict[_NEXT_PIXELS]], dim=1)
        images[index] = move_images(images[index], motion)
        first, second = images.split(pixels.shape[1], dim=1)
        out.set(keys.PIXELS, first.contiguous()).set(_NEXT_PIXELS, second.contiguous())
        moved = action.clone()
        moved[rows], turned_over = self._move(action[rows], motion)
        out.set(keys.ACTION, moved.to(device))
        for chosen, axes in ((motion.mirrored, "y"), (turned_over, "xy")):
            if chosen.any():
                these = index[chosen.to(device)]
                for key in _IN_HAND_KEYS:
                    image = out[key].clone()
                    image[these] = reverse_in_hand(image[these], axes)
                    out.set(key, image)
        return out

    def _draw(self, count: int) -> Motion:
        """Return random motions."""
        draws = torch.rand(2, count, generator=self._generator, dtype=torch.float64)
        shift = torch.zeros(count, 2, dtype=torch.float64)
        if self.motions in ("translation", "se2"):
            shift.normal_(0.0, SHIFT_SHARE, generator=self._generator)
        steps = {"cn": self.order, "d4": 4, "translation": 1}.get(self.motions)
        turn = draws[0] if steps is None else (draws[0] * steps).floor() / steps
        mirrored = draws[1] < 0.5 if self.motions == "d4" else torch.zeros(count, dtype=torch.bool)
        return Motion(mirrored, 2 * math.pi * turn, shift)

    def _positions(self, action: Tensor, motion: Motion) -> Tensor:
        """Return moved positions [B, 2], metres."""
        _, cos, sin = quarters_and_rotation(motion.angle_rad)
        x, y = (action[:, self._xy].double() - self._center).unbind(-1)
        y = torch.where(motion.mirrored, -y, y)
        turned = torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
        return turned + motion.shift * self._side + self._center

    def _stays_inside(self, action: Tensor, motion: Motion) -> Tensor:
        offset = (self._positions(action, motion) - self._center).abs()
        return (offset <= self._side / 2).all(dim=-1)

    def _move(self, action: Tensor, motion: Motion) -> tuple[Tensor, Tensor]:
        """Return actions [B, A] moved, angles wrapped, and where that turns the gripper over."""
        moved = action.double()
        moved[:, self._xy] = self._positions(action, motion)
        swapped = torch.zeros(len(action), dtype=torch.bool)
        if "rz" not in self.actions.components:
            return moved.to(action), swapped
        rz = self.actions.components.index("rz")
        yaw = torch.where(motion.mirrored, -moved[:, rz], moved[:, rz]) + motion.angle_rad
        yaw = yaw.remainder(2 * math.pi)
        if self.actions.half_rotation:
            swapped = yaw > math.pi
            yaw = torch.where(swapped, yaw - math.pi, yaw)
            for name in {"ry", "rx"} & set(self.actions.components):
                tilt = self.actions.components.index(name)
                moved[:, tilt] = torch.where(swapped, -moved[:, tilt], moved[:, tilt])
        moved[:, rz] = yaw
        return moved.to(action), swapped

    def get_extra_state(self) -> Tensor:
        """Return the generator's state, so that a checkpoint continues the same draws."""
        return self._generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Take over what ``get_extra_state`` returned."""
        self._generator.set_state(state.cpu())
