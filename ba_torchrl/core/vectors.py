"""VectorSpec: the declaration of numbers that an environment observes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torchrl.data import Unbounded

from ba_torchrl.core.errors import ConfigError

_SLACK = 0.01
"""Part of a range by which numbers may exceed it, and part of a quaternion's length."""


@dataclass(frozen=True)
class VectorSpec:
    """Names, unit, order and range of the numbers of an observation, and what is checked of them.

    The environment's specification, its documentation and the demonstrations that are read use
    these declarations.

    Args:
        names: of the numbers along the last axis, in order.
        unit: in words.
        low: smallest value of each.
        high: largest value of each. Both are wide: they tell units apart, not places.
        rows: number of rows of points; None for one vector.
        quaternion: index of the x of a unit quaternion x, y, z, w; None without one. Its x is not
            negative, since a quaternion and its negative are the same rotation.
        max_tilt_rad: largest angle between that rotation's z axis and straight down.
    """

    names: tuple[str, ...]
    unit: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    rows: int | None = None
    quaternion: int | None = None
    max_tilt_rad: float = math.pi

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows, if there are any, and numbers."""
        return (len(self.names),) if self.rows is None else (self.rows, len(self.names))

    def to_tensor_spec(self) -> Unbounded:
        """Return the observation's TorchRL specification."""
        return Unbounded(self.shape, device="cpu", dtype=torch.float32)

    def fitted(self, values: np.ndarray) -> np.ndarray:
        """Return numbers [T, ...] of somebody else, quaternions with the sign of the declaration.

        Raises:
            ConfigError: they contradict the declaration; the message says what would fit.
        """
        slack = _SLACK * (np.array(self.high) - np.array(self.low))
        out = (values < np.array(self.low) - slack) | (values > np.array(self.high) + slack)
        if out.any():
            number = int(np.argwhere(out)[0][-1])
            found = values[..., number]
            raise ConfigError(
                f"{self.names[number]} has values from {found.min():g} to {found.max():g}, needed "
                f"{self.low[number]:g} to {self.high[number]:g} ({self.unit}); set scale and offset"
            )
        if self.quaternion is None:
            return values
        place = slice(self.quaternion, self.quaternion + 4)
        turns = values[..., place]
        lengths = np.linalg.norm(turns, axis=-1)
        if (abs(lengths - 1) > _SLACK).any():
            raise ConfigError(
                f"has quaternions of lengths from {lengths.min():g} to {lengths.max():g}, needed 1"
            )
        self._check_tilts(turns)
        signs = np.where(turns[..., :1] < 0, -1, 1).astype(values.dtype)
        return np.concatenate(
            [values[..., : place.start], turns * signs, values[..., place.stop :]], axis=-1
        )

    def _check_tilts(self, turns: np.ndarray) -> None:
        limit = self.max_tilt_rad
        if (tilt := _tilts(turns).max(initial=0)) <= limit:
            return
        first = self.quaternion or 0
        hint = "check the frame and the order of its quaternion, x, y, z, w"
        if _tilts(np.roll(turns, -1, axis=-1)).max() <= limit:
            order = [first + 1, first + 2, first + 3, first]
            hint = (
                "in the order w, x, y, z its quaternion would fit: in the mapping, let components "
                f"have {order} in place of {sorted(order)}"
            )
        raise ConfigError(
            f"the gripper is tilted by up to {math.degrees(tilt):.0f} degrees, needed at most "
            f"{math.degrees(limit):g}, pointing down; {hint}"
        )


def _tilts(turns: np.ndarray) -> np.ndarray:
    """Return the angles between the z axes of quaternions x, y, z, w and straight down."""
    return np.arccos(np.clip(2 * (turns[..., 0] ** 2 + turns[..., 1] ** 2) - 1, -1, 1))


def downward_yaws(turns: np.ndarray) -> np.ndarray:
    """Return the yaws [...] of a gripper that points down, from quaternions [..., 4], radians."""
    return 2 * np.arctan2(turns[..., 1], turns[..., 0])
