"""Rigid transforms of sampled open-loop transitions: images and the pose of the action."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor

from ba_torchrl.core import keys
from ba_torchrl.core.actions import OpenLoopActions
from ba_torchrl.core.errors import check_choice
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.data.augmentation.so2 import (
    SeededTransform,
    copy_exact_quarters,
    image_pairs,
    map_pairs,
    quarters_and_rotation,
    require_known_frames,
)
from ba_torchrl.data.transfer import to_device

RigidTransforms = Literal["translation", "cn", "d4", "se2"]
"""Translations; rotations of C_n; quarter turns and reflections; rotations and translations."""

SHIFT_SHARE = 0.05
"""Standard deviation of a translation, as a fraction of the workspace's side."""
ATTEMPTS = 10
"""Largest number of transforms drawn for a transition until its action stays in the workspace."""


class RigidTransform(NamedTuple):
    """Rigid transforms about the workspace's centre: reflect y, then rotate, then translate."""

    mirrored: Tensor
    """bool [B]."""
    angle_rad: Tensor
    """float64 [B]."""
    shift: Tensor
    """float64 [B, 2] of x and y, in sides of the workspace."""


def transform_images(images: Tensor, transform: RigidTransform) -> Tensor:
    """Return images transformed with the scene; pixels from outside the image are zero.

    Quarter turns and reflections without a translation are exact, other transforms bilinear.

    Args:
        images: [B, C, H, H], rows along +x, columns along +y.
        transform: of B images.
    """
    quarters, cos, sin = quarters_and_rotation(transform.angle_rad)
    sign = torch.where(transform.mirrored, -1.0, 1.0).to(cos)
    tx, ty = (2 * transform.shift).unbind(-1)
    # Source of an output pixel in (column, row): the inverse transform.
    rows = [
        torch.stack([sign * cos, -sign * sin, sign * (sin * tx - cos * ty)], dim=-1),
        torch.stack([sin, cos, -cos * tx - sin * ty], dim=-1),
    ]
    source = to_device(torch.stack(rows, dim=1).to(images.dtype), images.device)
    grid = F.affine_grid(source, list(images.shape), False)
    transformed = F.grid_sample(images, grid, padding_mode="zeros", align_corners=False)
    is_centred = (transform.shift == 0).all(dim=-1)
    for flip in (False, True):
        chosen = torch.where(is_centred & (transform.mirrored == flip), quarters, -1)
        copy_exact_quarters(transformed, images.flip(-1) if flip else images, chosen)
    return transformed


class ActionGrid(Protocol):
    """A grid of actions."""

    def nearest(self, action: Tensor) -> Tensor:
        """Return the actions of the grid that are nearest to actions [B, A]."""

    def swaps_fingers(self, action: Tensor) -> Tensor:
        """Return whether the nearest yaws are half a turn away from the nearest ones of the grid,
        which swaps the fingers, bool [B]."""


class RigidAugmentation(SeededTransform):
    """Turns, mirrors or shifts sampled transitions at random: both images and one action.

    Images with the gripper's axes do not change, with two exceptions: a reflection reverses the
    gripper's y axis, and a yaw that is wrapped into half a turn, or rounded to the other end of it,
    reverses both axes. A transition is unchanged if no drawn transform keeps its action within the
    workspace.

    Equal moves [K, A] under ``target_moves`` are transformed too. Moves that would leave the
    workspace, and places that would need the other orientation of the image of what is held, become
    the first move.

    Args:
        transforms: set of transforms, see `RigidTransforms`.
        actions: the environment's action vector.
        images: declarations of the images by key.
        seed: of the module's own draws.
        probability: of transforming a transition.
        order: n of C_n.
        grid: of actions, to whose nearest ones transformed actions are rounded; None to keep them
            as they are.
        action_key: entry of that action; the batch's other action is left out.

    Raises:
        ValueError: the probability is outside [0, 1], the order is not positive, an image cannot be
            transformed, the transforms rotate and the action has no yaw, or they reflect and the
            action has tilts.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ba_torchrl.core.actions import OpenLoopActions
        >>> from ba_torchrl.core.images import ImageSpec
        >>> from ba_torchrl.data import RigidAugmentation
        >>> workspace_m = ((0.25, 0.65), (-0.2, 0.2), (0.01, 0.25))
        >>> images = {"heightmap": ImageSpec(channels=1, size=64, high=0.25)}
        >>> actions = OpenLoopActions("pxyr", workspace_m)
        >>> transform = RigidAugmentation("se2", actions, images, seed=0)
        >>> batch = {"heightmap": torch.rand(8, 1, 64, 64), "action": torch.zeros(8, 4)}
        >>> batch["action"][:, 1] = 0.45  # the workspace's centre
        >>> batch["next"] = {"heightmap": torch.rand(8, 1, 64, 64)}
        >>> moved = transform(TensorDict(batch, [8]))  # or replay.append_transform(transform)
        >>> moved["heightmap"].shape, moved["action"].shape
        (torch.Size([8, 1, 64, 64]), torch.Size([8, 4]))
    """

    def __init__(
        self,
        transforms: RigidTransforms,
        actions: OpenLoopActions,
        images: Mapping[str, ImageSpec],
        *,
        seed: int,
        probability: float = 1.0,
        order: int = 16,
        grid: ActionGrid | None = None,
        action_key: str = keys.ACTION,
    ) -> None:
        super().__init__([*image_pairs(images), action_key], seed)
        check_choice("transforms", transforms, RigidTransforms)
        if not 0 <= probability <= 1 or order < 1:
            raise ValueError(
                f"probability must be in [0, 1] and order positive, got {probability}, {order}"
            )
        require_known_frames(images)
        if transforms != "translation":
            if "rz" not in actions.components:
                raise ValueError(
                    f"{transforms!r} rotates the scene, and the action "
                    f"{actions.sequence!r} has no yaw to rotate with it; use 'translation'"
                )
            if transforms == "d4" and {"ry", "rx"} & set(actions.components):
                raise ValueError("'d4' reflects the scene, which tilts do not follow")
        self.transforms = transforms
        self.actions = actions
        self.probability = probability
        self.order = order
        self._grid = grid
        self._action_key = action_key
        self._scene_images = [key for key, image in images.items() if image.frame == "scene"]
        self._gripper_images = {
            key: image for key, image in images.items() if image.frame == "gripper"
        }
        self._xy = [actions.components.index(name) for name in "xy"]
        bounds = torch.tensor(actions.bounds_m[:2], dtype=torch.float64, device="cpu")
        self._center, self._side = bounds.mean(dim=1), bounds[:, 1] - bounds[:, 0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return a copy of a batch of transitions [B] with some of them transformed.

        Args:
            tensordict: holds the images, the action and their successors.
        """
        out = self._copied(tensordict)
        others = {keys.ACTION, keys.TARGET_ACTION} - {self._action_key}
        out = out.exclude(*others)
        device = out[self._action_key].device
        action = out[self._action_key].cpu()
        is_found, transform = self._draw_inside(action)
        if not is_found.any():
            return out
        rows = is_found.nonzero().squeeze(-1)
        transform = RigidTransform(*(part[rows] for part in transform))
        for key in self._scene_images:
            map_pairs(out, key, rows, lambda images: transform_images(images, transform))
        moved = action.clone()
        moved[rows], is_turned_over = self._transform_actions(action[rows], transform)
        out.set(self._action_key, to_device(moved, device))
        if keys.TARGET_MOVES in out:
            self._transform_moves(out, rows, transform, is_turned_over)
        for chosen, axes in ((transform.mirrored, "y"), (is_turned_over, "xy")):
            if chosen.any():
                self._reverse_axes(out, rows[chosen], axes)
        return out

    def _draw_inside(self, action: Tensor) -> tuple[Tensor, RigidTransform]:
        """Return which actions [B, A] are transformed, bool [B], and the drawn transforms."""
        is_wanted = (
            torch.rand(len(action), generator=self._generator, device="cpu", dtype=torch.float32)
            < self.probability
        )
        transform = self._draw(len(action))
        is_found = is_wanted & self._stays_inside(action, transform)
        for _ in range(ATTEMPTS - 1):
            again = self._draw(len(action))
            fits = is_wanted & ~is_found & self._stays_inside(action, again)
            transform = RigidTransform(
                *(
                    torch.where(fits.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                    for new, old in zip(again, transform, strict=True)
                )
            )
            is_found |= fits
        return is_found, transform

    def _draw(self, count: int) -> RigidTransform:
        """Return random transforms."""
        draws = torch.rand(2, count, generator=self._generator, dtype=torch.float64, device="cpu")
        shift = torch.zeros(count, 2, dtype=torch.float64, device="cpu")
        if self.transforms in ("translation", "se2"):
            shift.normal_(0.0, SHIFT_SHARE, generator=self._generator)
        steps = {"cn": self.order, "d4": 4, "translation": 1}.get(self.transforms)
        turn = draws[0] if steps is None else (draws[0] * steps).floor() / steps
        mirrored = torch.zeros(count, dtype=torch.bool, device="cpu")
        if self.transforms == "d4":
            mirrored = draws[1] < 0.5
        return RigidTransform(mirrored, 2 * math.pi * turn, shift)

    def _positions(self, action: Tensor, transform: RigidTransform) -> Tensor:
        """Return transformed positions [B, 2], metres."""
        _, cos, sin = quarters_and_rotation(transform.angle_rad)
        x, y = (action[:, self._xy].double() - self._center).unbind(-1)
        y = torch.where(transform.mirrored, -y, y)
        rotated = torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
        return rotated + transform.shift * self._side + self._center

    def _stays_inside(self, action: Tensor, transform: RigidTransform) -> Tensor:
        offset = (self._positions(action, transform) - self._center).abs()
        return (offset <= self._side / 2).all(dim=-1)

    def _transform_actions(
        self, action: Tensor, transform: RigidTransform
    ) -> tuple[Tensor, Tensor]:
        """Return transformed actions [B, A], and whether their wrapped yaw swaps the fingers
        [B]."""
        moved = action.double()
        moved[:, self._xy] = self._positions(action, transform)
        is_turned_over = torch.zeros(len(action), dtype=torch.bool, device="cpu")
        if "rz" not in self.actions.components:
            return moved.to(action), is_turned_over
        rz = self.actions.components.index("rz")
        yaw = torch.where(transform.mirrored, -moved[:, rz], moved[:, rz]) + transform.angle_rad
        yaw = yaw.remainder(2 * math.pi)
        if self.actions.half_rotation:
            is_turned_over = yaw > math.pi
            yaw = torch.where(is_turned_over, yaw - math.pi, yaw)
            for name in {"ry", "rx"} & set(self.actions.components):
                tilt = self.actions.components.index(name)
                moved[:, tilt] = torch.where(is_turned_over, -moved[:, tilt], moved[:, tilt])
        moved[:, rz] = yaw
        moved = moved.to(action)
        if self._grid is not None:
            is_turned_over ^= self._grid.swaps_fingers(moved)
            moved = self._grid.nearest(moved)
        return moved, is_turned_over

    def _transform_moves(
        self,
        out: TensorDictBase,
        rows: Tensor,
        transform: RigidTransform,
        is_turned_over: Tensor,
    ) -> None:
        """Transform the equal moves in some rows of a batch, whose first moves are the actions.

        Args:
            out: the batch, whose images with the gripper's axes are not reversed yet.
            rows: int64 [R].
            transform: of these rows.
            is_turned_over: whether these images are reversed with both axes, bool [R].
        """
        moves = out[keys.TARGET_MOVES]
        chosen = moves.cpu()[rows]
        count = chosen.shape[1]
        flat = chosen.flatten(0, 1)
        each = RigidTransform(*(part.repeat_interleave(count, dim=0) for part in transform))
        turned, is_over = self._transform_actions(flat, each)
        fits = self._stays_inside(flat, each).reshape(-1, count)
        holding = out[keys.HOLDING].cpu()[rows].reshape(-1, 1)
        fits &= ~holding | (is_over.reshape(-1, count) == is_turned_over[:, None])
        turned = turned.reshape(chosen.shape)
        turned = torch.where(fits[:, :, None], turned, turned[:, :1])
        changed = moves.clone()
        changed[to_device(rows, moves.device)] = to_device(turned, moves.device)
        out.set(keys.TARGET_MOVES, changed)

    def _reverse_axes(self, out: TensorDictBase, rows: Tensor, axes: str) -> None:
        """Reverse axes of the images with the gripper's axes, in some rows of a batch."""
        for key, spec in self._gripper_images.items():
            for nested in (key, (keys.NEXT, key)):
                image = out[nested].clone()
                index = to_device(rows, image.device)
                image[index] = spec.reverse_axes(image[index], axes)
                out.set(nested, image)
