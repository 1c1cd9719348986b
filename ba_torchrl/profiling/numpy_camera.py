"""A height camera in NumPy, for comparison with the compiled one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ba_torchrl.sim.bodies import Body


class NumpyHeightCamera:
    """The heightmap of `ba_torchrl.sim.vision.depth.HeightCamera`, without decals and numba.

    All pairs of a triangle and a pixel of its bounding box are computed at once.

    Args:
        bodies: visible bodies; the floor has height 0.
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        self._bodies = list(bodies)
        self._meshes = [body.shape.mesh() for body in bodies]
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in self._meshes])[:-1]
        self._faces = np.concatenate(
            [mesh.faces + start for mesh, start in zip(self._meshes, starts, strict=True)]
        )

    def heightmap(self, center_m: tuple[float, float], side_m: float, pixels: int) -> np.ndarray:
        """Return the height of the highest surface at each pixel.

        Args:
            center_m: x and y of the image's centre.
            side_m: width of the image.
            pixels: number of rows and columns.

        Returns:
            [pixels, pixels] float64, metres above the floor.
        """
        vertices = np.concatenate(
            [
                body.pose.apply(mesh.vertices)
                for body, mesh in zip(self._bodies, self._meshes, strict=True)
            ]
        )
        # rows and columns, with integers at pixel centres
        scale = pixels / side_m
        vertices[:, :2] = (vertices[:, :2] - center_m + side_m / 2) * scale - 0.5
        corners = vertices[self._faces]
        a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
        up = area > 1e-12
        corners, a, ab, ac, area = corners[up], a[up], ab[up], ac[up], area[up]

        low = np.maximum(np.ceil(corners[..., :2].min(axis=1)), 0).astype(int)
        high = np.minimum(np.floor(corners[..., :2].max(axis=1)), pixels - 1).astype(int)
        rows, cols = np.maximum(high - low + 1, 0).T
        counts = rows * cols
        face = np.repeat(np.arange(len(counts)), counts)
        nth = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        row, col = low[face, 0] + nth // cols[face], low[face, 1] + nth % cols[face]

        di, dj = row - a[face, 0], col - a[face, 1]
        u = (di * ac[face, 1] - ac[face, 0] * dj) / area[face]
        v = (ab[face, 0] * dj - di * ab[face, 1]) / area[face]
        inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
        height = a[face, 2] + u * ab[face, 2] + v * ac[face, 2]
        image = np.zeros((pixels, pixels))
        np.maximum.at(image, (row[inside], col[inside]), height[inside])
        return image
