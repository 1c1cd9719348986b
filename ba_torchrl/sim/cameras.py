"""Orthographic height images from body poses, and RGB pictures for people.

The height image is rasterised here, from the triangles of the bodies' meshes. Compared on 128 x 128
pixels with four cubes (`recipes/speed.py` prints it): PyBullet's TinyRenderer takes milliseconds,
cannot be asked to leave out the arm cheaply, shifts edges by half a pixel and its orthographic
depth does not read linearly; a NumPy z-buffer is correct and takes tenths of a millisecond; the
compiled one below gives the same numbers in hundredths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numba
import numpy as np
import pybullet

from ba_torchrl.sim.bodies import Body, Decal

if TYPE_CHECKING:
    from ba_torchrl.sim.world import World


@numba.njit(cache=True)
def _transform(vertices, owner, poses, out):  # noqa: ANN001, ANN202 -- compiled
    """Move each vertex by the pose (x, y, z, qx, qy, qz, qw) of its body."""
    for v in range(vertices.shape[0]):
        x, y, z, qx, qy, qz, qw = poses[owner[v]]
        a, b, c = vertices[v]
        # t = 2 q x v; v' = v + w t + q x t
        tx, ty, tz = 2 * (qy * c - qz * b), 2 * (qz * a - qx * c), 2 * (qx * b - qy * a)
        out[v, 0] = x + a + qw * tx + qy * tz - qz * ty
        out[v, 1] = y + b + qw * ty + qz * tx - qx * tz
        out[v, 2] = z + c + qw * tz + qx * ty - qy * tx


@numba.njit(cache=True)
def _rasterise(vertices, faces, x0, y0, pixel, image):  # noqa: ANN001, ANN202 -- compiled
    """Raise ``image`` to the height of the upward faces; pixels are sampled at their centres."""
    rows, cols = image.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f]
        ax, ay = (vertices[a, 0] - x0) / pixel - 0.5, (vertices[a, 1] - y0) / pixel - 0.5
        bx, by = (vertices[b, 0] - x0) / pixel - 0.5, (vertices[b, 1] - y0) / pixel - 0.5
        cx, cy = (vertices[c, 0] - x0) / pixel - 0.5, (vertices[c, 1] - y0) / pixel - 0.5
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area <= 1e-12:
            continue  # faces down or is edge-on
        i0 = max(0, math.ceil(min(ax, bx, cx)))
        i1 = min(rows - 1, math.floor(max(ax, bx, cx)))
        j0 = max(0, math.ceil(min(ay, by, cy)))
        j1 = min(cols - 1, math.floor(max(ay, by, cy)))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                u = ((i - ax) * (cy - ay) - (cx - ax) * (j - ay)) / area
                v = ((bx - ax) * (j - ay) - (i - ax) * (by - ay)) / area
                if u >= -1e-9 and v >= -1e-9 and u + v <= 1 + 1e-9:
                    height = (
                        vertices[a, 2]
                        + u * (vertices[b, 2] - vertices[a, 2])
                        + v * (vertices[c, 2] - vertices[a, 2])
                    )
                    image[i, j] = max(image[i, j], height)


@numba.njit(cache=True)
def paint_square(
    image: np.ndarray,
    center_px: tuple[float, float],
    half_px: float,
    yaw_rad: float,
    value: float,
) -> None:
    """Set the pixels whose centres lie in a rotated square.

    Args:
        image: [H, W], changed in place.
        center_px: row and column of the square's centre; pixel (i, j) has its at (i+1/2, j+1/2).
        half_px: half the square's edge.
        yaw_rad: turn from rows towards columns.
        value: what to write.
    """
    reach = half_px * math.sqrt(2)
    x, y = center_px
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    limit = half_px + 1e-9
    for i in range(max(0, math.floor(x - reach)), min(image.shape[0], math.ceil(x + reach))):
        for j in range(max(0, math.floor(y - reach)), min(image.shape[1], math.ceil(y + reach))):
            di, dj = i + 0.5 - x, j + 0.5 - y
            if abs(cos * di + sin * dj) <= limit and abs(cos * dj - sin * di) <= limit:
                image[i, j] = value


class HeightCamera:
    """Looks straight down on a set of bodies, without perspective and without the arm.

    Rows follow +x, columns +y; a pixel stands for its centre.

    Args:
        bodies: what the camera sees besides the floor (height 0).
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        self._decals = [body for body in bodies if isinstance(body.shape, Decal)]
        self._bodies = [body for body in bodies if not isinstance(body.shape, Decal)]
        meshes = [body.shape.mesh() for body in self._bodies]
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        self._vertices = np.concatenate([mesh.vertices for mesh in meshes])
        self._owner = np.repeat(np.arange(len(meshes)), np.diff(starts))
        self._faces = np.concatenate(
            [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
        )
        self._poses = np.empty((len(meshes), 7))
        self._moved = np.empty_like(self._vertices)

    def heightmap(self, center_m: tuple[float, float], side_m: float, pixels: int) -> np.ndarray:
        """Return the height of what is seen.

        Args:
            center_m: x and y of the image's centre.
            side_m: width of the image.
            pixels: number of rows and columns.

        Returns:
            [pixels, pixels] float64, metres above the floor.
        """
        image = np.zeros((pixels, pixels))
        pixel = side_m / pixels
        x0, y0 = center_m[0] - side_m / 2, center_m[1] - side_m / 2
        for decal in self._decals:
            (x, y, _), _ = decal.pose
            paint_square(
                image,
                ((x - x0) / pixel, (y - y0) / pixel),
                decal.shape.size_m[0] / 2 / pixel,
                decal.yaw_rad,
                -decal.shape.depth_m,
            )
        for row, body in zip(self._poses, self._bodies, strict=True):
            row[:3], row[3:] = body.pose
        _transform(self._vertices, self._owner, self._poses, self._moved)
        _rasterise(self._moved, self._faces, x0, y0, pixel, image)
        return image


def render_rgb(
    world: World,
    target_m: tuple[float, float, float],
    width: int = 480,
    height: int = 360,
    distance_m: float = 0.72,
    yaw_deg: float = 60.0,
    pitch_deg: float = -24.0,
) -> np.ndarray:
    """Return a picture of the whole scene, arm included, for people to look at.

    Args:
        world: what to draw.
        target_m: the point in the picture's centre.
        width: pixels across.
        height: pixels down.
        distance_m: from the target to the camera.
        yaw_deg: camera's turn about z.
        pitch_deg: camera's pitch; negative looks down.

    Returns:
        [height, width, 3] uint8.
    """
    view = pybullet.computeViewMatrixFromYawPitchRoll(
        target_m, distance_m, yaw_deg, pitch_deg, 0, 2
    )
    projection = pybullet.computeProjectionMatrixFOV(50, width / height, 0.05, 5.0)
    rgba = pybullet.getCameraImage(
        width,
        height,
        view,
        projection,
        shadow=1,
        lightDirection=(0.4, -0.6, 1.5),
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=world.client,
    )[2]
    return np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[..., :3].copy()
