"""Compiled projections of the voxels below a heightmap in the frame of a tool."""

# ruff: noqa: ANN001, ANN201, ANN202 -- compiled functions

from __future__ import annotations

import math

import numpy as np

from ba_torchrl._jit import njit

TIE_TOLERANCE = 1e-9
"""Voxels. A rotated voxel centre this close to halfway between two cells belongs to the upper one,
so that rounding errors of the rotation do not decide."""


@njit()
def project(heights, levels, rotation):
    """Return the numbers of occupied voxels along the three axes of the tool frame.

    A voxel is occupied if its level is below the height of its pixel. Occupied voxels are rotated
    about the centre of the cube into the nearest cells of the tool frame, and the cells are
    filtered by a median with a kernel of 2 x 2 x 2, where a tie is occupied: the kernel of cell
    (i, j, k) starts at (i - 1, j - 1, k - 1), and the border is replicated.

    Args:
        heights: [n, n] metres.
        levels: [n] heights of the voxels' centres, increasing, metres.
        rotation: [3, 3] of the tool frame in the frame of the heightmap.

    Returns:
        [3, n, n] float64, sums over the first, second and third axis of the tool frame.
    """
    n = len(levels)
    middle = (n - 1) / 2
    voxels = np.zeros((n, n, n), dtype=np.uint8)
    for i in range(n):
        for j in range(n):
            a, b = i - middle, j - middle
            for k in range(n):
                if not heights[i, j] > levels[k]:
                    break
                c = k - middle
                x = _cell(a * rotation[0, 0] + b * rotation[1, 0] + c * rotation[2, 0] + middle)
                y = _cell(a * rotation[0, 1] + b * rotation[1, 1] + c * rotation[2, 1] + middle)
                z = _cell(a * rotation[0, 2] + b * rotation[1, 2] + c * rotation[2, 2] + middle)
                if 0 <= x < n and 0 <= y < n and 0 <= z < n:
                    voxels[x, y, z] = 1
    sums = np.zeros((3, n, n))
    for i in range(n):
        before_i = max(i - 1, 0)
        for j in range(n):
            before_j = max(j - 1, 0)
            previous = 0
            for k in range(n):
                count = (
                    voxels[before_i, before_j, k]
                    + voxels[before_i, j, k]
                    + voxels[i, before_j, k]
                    + voxels[i, j, k]
                )
                if k == 0:
                    previous = count
                if previous + count >= 4:
                    sums[0, j, k] += 1
                    sums[1, i, k] += 1
                    sums[2, i, j] += 1
                previous = count
    return sums


@njit(inline="always")
def _cell(position):
    return math.floor(position + 0.5 + TIE_TOLERANCE)
