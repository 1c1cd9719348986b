"""In-hand images of the held object, cropped from the heightmap before the pick.

Images are in the tool frame: rows run along the closing axis of the fingers, and the tool point is
at the centre. A pixel is as large as the heightmap's.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np

from ba_torchrl.core.registry import Registry
from ba_torchrl.sim.geometry import euler_matrix
from ba_torchrl.sim.vision.kernels import project


class PickView(NamedTuple):
    """Heightmaps before and after a pick, and the pose of the tool at the grasp."""

    before: np.ndarray
    """[N, N] heightmap before the pick, metres."""
    after: np.ndarray
    """[N, N] heightmap after the pick, metres."""
    center_px: tuple[float, float]
    """Row and column of the tool point; the centre of pixel (i, j) is (i + 1/2, j + 1/2)."""
    pixel_m: float
    """Edge of a pixel."""
    z_m: float
    """Height of the tool point."""
    rz_rad: float
    """Rotation of the tool about z; the angles are as in `tool_rotation`."""
    ry_rad: float = 0.0
    rx_rad: float = 0.0


class InHandImage(ABC):
    """A method to compute the in-hand image."""

    channels: ClassVar[int] = 1

    @abstractmethod
    def draw(self, view: PickView, size: int) -> np.ndarray:
        """Return the in-hand image of a pick, [channels, size, size] float64."""


IN_HAND_MODES: Registry[type[InHandImage]] = Registry("in_hand_mode", "ba_torchrl.sim", InHandImage)


@IN_HAND_MODES.register("raw")
class RawImage(InHandImage):
    """Heights around the tool point before the pick, rotated into the tool frame."""

    def draw(self, view: PickView, size: int) -> np.ndarray:
        """Return heights [1, size, size] in metres."""
        return crop(view.before, view.center_px, size, view.rz_rad)[None]


@IN_HAND_MODES.register("sub")
class SubtractedImage(InHandImage):
    """Like "raw", with the highest remaining height subtracted from all heights above it.

    The remaining height is the maximum around the tool point after the pick.
    """

    def draw(self, view: PickView, size: int) -> np.ndarray:
        """Return heights [1, size, size] in metres."""
        remaining = crop(view.after, view.center_px, size).max()
        before = np.where(view.before >= remaining, view.before - remaining, view.before)
        return crop(before, view.center_px, size, view.rz_rad)[None]


@IN_HAND_MODES.register("proj")
class ProjectedImage(InHandImage):
    """Projections of the occupied voxels along the three axes of the tool frame (appendix D.2).

    A voxel below the height of its pixel is occupied. The voxel grid is a cube whose centre is the
    tool point.
    """

    channels = 3

    def draw(self, view: PickView, size: int) -> np.ndarray:
        """Return numbers of occupied voxels along the x, y and z axes, [3, size, size]."""
        heights = crop(view.before, view.center_px, size).round(5)
        middle = (size - 1) / 2
        levels = view.z_m + (np.arange(size) - middle) * view.pixel_m
        rotation = np.array(euler_matrix(view.rz_rad, view.ry_rad, view.rx_rad))
        return project(heights, levels, rotation)


def crop(
    heightmap: np.ndarray, center_px: tuple[float, float], size: int, rz_rad: float = 0.0
) -> np.ndarray:
    """Return a square [size, size] of a heightmap, interpolated bilinearly and zero outside of it.

    It is rotated about its centre, given in row and column, from rows towards columns of the
    heightmap.
    """
    offset = np.arange(size) - (size - 1) / 2
    cos, sin = math.cos(rz_rad), math.sin(rz_rad)
    rows = center_px[0] - 0.5 + cos * offset[:, None] - sin * offset[None, :]
    columns = center_px[1] - 0.5 + sin * offset[:, None] + cos * offset[None, :]
    padded = np.pad(np.asarray(heightmap, dtype=np.float64), 1)
    limit = np.array(padded.shape) - 2.0
    rows = np.clip(rows + 1, 0, limit[0] + 1 - 1e-9)
    columns = np.clip(columns + 1, 0, limit[1] + 1 - 1e-9)
    return bilinear(padded, rows, columns)


def bilinear(image: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return an image at non-negative fractional rows and columns, interpolated bilinearly."""
    i, j = rows.astype(np.int64), columns.astype(np.int64)
    u, v = rows - i, columns - j
    return (
        (1 - u) * (1 - v) * image[i, j]
        + u * (1 - v) * image[i + 1, j]
        + (1 - u) * v * image[i, j + 1]
        + u * v * image[i + 1, j + 1]
    )
