"""Images of what the gripper holds, cut from the heightmap that was there before the pick.

They live in the frame of the gripper: rows run along the line on which the fingers close. The tool
point is in the middle of the image, and pixels are as large as the heightmap's.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np

from ba_torchrl.registry import Registry
from ba_torchrl.sim.geometry import euler_matrix

IN_HAND_MODES: Registry[type[InHandImage]] = Registry("in_hand_mode", "ba_torchrl.sim")


class PickView(NamedTuple):
    """A pick as seen from above."""

    before: np.ndarray
    """[N, N] heightmap before it, metres."""
    after: np.ndarray
    """[N, N] heightmap after it."""
    center_px: tuple[float, float]
    """Row and column of the tool point; pixel (i, j) has its centre at (i + 1/2, j + 1/2)."""
    pixel_m: float
    z_m: float
    """Height of the tool point."""
    rz_rad: float
    ry_rad: float = 0.0
    rx_rad: float = 0.0


class InHandImage(ABC):
    """A way to show what is held."""

    channels: ClassVar[int] = 1

    @abstractmethod
    def draw(self, view: PickView, size: int) -> np.ndarray:
        """Return the image of a pick, [channels, size, size] float64."""


@IN_HAND_MODES.register("raw")
class RawImage(InHandImage):
    """The heights around the tool point before the pick, turned into the gripper's frame."""

    def draw(self, view: PickView, size: int) -> np.ndarray:
        """Return heights [1, size, size] in metres."""
        return crop(view.before, view.center_px, size, view.rz_rad)[None]


@IN_HAND_MODES.register("sub")
class SubtractedImage(InHandImage):
    """As raw, but measured from the top of what the pick left behind, where higher than that."""

    def draw(self, view: PickView, size: int) -> np.ndarray:
        """Return heights [1, size, size] in metres."""
        left = crop(view.after, view.center_px, size).max()
        before = np.where(view.before >= left, view.before - left, view.before)
        return crop(before, view.center_px, size, view.rz_rad)[None]


@IN_HAND_MODES.register("proj")
class ProjectedImage(InHandImage):
    """The space below the surface, as voxels in the gripper's frame, counted along three axes.

    The voxels reach as far above and below the tool point as to its sides (appendix D.2).
    """

    channels = 3

    def draw(self, view: PickView, size: int) -> np.ndarray:
        """Return numbers of voxels [3, size, size]: seen along x, y and z of the gripper."""
        heights = crop(view.before, view.center_px, size).round(5)
        middle = (size - 1) / 2
        levels = view.z_m + (np.arange(size) - middle) * view.pixel_m
        occupied = np.argwhere(heights[:, :, None] > levels) - middle
        turn = np.array(euler_matrix(view.rz_rad, view.ry_rad, view.rx_rad))
        cells = np.rint(occupied @ turn + middle).astype(np.int64)  # into the gripper's frame
        cells = cells[((cells >= 0) & (cells < size)).all(axis=1)]
        voxels = np.zeros((size, size, size), dtype=bool)
        voxels[tuple(cells.T)] = True
        voxels = _median_filter(voxels)
        return np.stack([voxels.sum(axis=axis) for axis in range(3)]).astype(np.float64)


def crop(
    heightmap: np.ndarray, center_px: tuple[float, float], size: int, rz_rad: float = 0.0
) -> np.ndarray:
    """Return a turned square of a heightmap, interpolated bilinearly, zero beyond its border.

    Args:
        heightmap: [N, N].
        center_px: row and column of the square's centre.
        size: pixels along each side.
        rz_rad: turn of the square's rows, from rows towards columns of the heightmap.

    Returns:
        [size, size] float64.
    """
    offset = np.arange(size) - (size - 1) / 2
    cos, sin = math.cos(rz_rad), math.sin(rz_rad)
    rows = center_px[0] - 0.5 + cos * offset[:, None] - sin * offset[None, :]
    columns = center_px[1] - 0.5 + sin * offset[:, None] + cos * offset[None, :]
    padded = np.pad(np.asarray(heightmap, dtype=np.float64), 1)
    limit = np.array(padded.shape) - 2.0
    rows = np.clip(rows + 1, 0, limit[0] + 1 - 1e-9)
    columns = np.clip(columns + 1, 0, limit[1] + 1 - 1e-9)
    i, j = rows.astype(np.int64), columns.astype(np.int64)
    u, v = rows - i, columns - j
    return (
        (1 - u) * (1 - v) * padded[i, j]
        + u * (1 - v) * padded[i + 1, j]
        + (1 - u) * v * padded[i, j + 1]
        + u * v * padded[i + 1, j + 1]
    )


def _median_filter(voxels: np.ndarray) -> np.ndarray:
    """Return which cells have four of the eight cells filled that end at them along each axis."""
    padded = np.pad(voxels, ((1, 0), (1, 0), (1, 0)), mode="edge").astype(np.int8)
    n = voxels.shape[0]
    count = sum(
        padded[a : a + n, b : b + n, c : c + n] for a in (0, 1) for b in (0, 1) for c in (0, 1)
    )
    return count >= 4
