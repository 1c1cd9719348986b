"""Projections of voxels in the frame of a tool, voxel by voxel."""

import math

import numpy as np

from ba_torchrl.sim.geometry import euler_matrix


def project_by_loops(heights, pixel_m, z_m, rz, ry, rx, middle=None, lowest=0):
    """Return the projections [3, n, n] of a heightmap [n, n] in the frame of a tool.

    ``middle`` is the index about which voxels are rotated, by default that of the cube's centre;
    cells below ``lowest`` stay empty.
    """
    n = len(heights)
    middle = (n - 1) / 2 if middle is None else middle

    tool = np.array(euler_matrix(rz, ry, rx))
    cells = set()
    for i, j, k in np.ndindex(n, n, n):
        if heights[i, j] > z_m + (k - middle) * pixel_m:
            inside = tool.T @ (np.array([i, j, k]) - middle) + middle
            # at 45 degrees some centres are halfway between two cells: the upper one
            cell = tuple(math.floor(value + 0.5 + 1e-9) for value in inside)
            if all(lowest <= index < n for index in cell):
                cells.add(cell)
    image = np.zeros((3, n, n))
    for i, j, k in np.ndindex(n, n, n):
        kernel = [(max(i - a, 0), max(j - b, 0), max(k - c, 0)) for a, b, c in np.ndindex(2, 2, 2)]
        if sum(cell in cells for cell in kernel) >= 4:
            image[0, j, k] += 1
            image[1, i, k] += 1
            image[2, i, j] += 1
    return image
