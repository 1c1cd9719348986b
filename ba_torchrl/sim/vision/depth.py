"""Depth images, height images and point clouds from body poses.

All are rasterised here, from the triangles of the bodies' meshes. Compared on 128 x 128 pixels with
four cubes (`recipes/speed.py` prints it): PyBullet's TinyRenderer takes milliseconds, cannot be
asked to leave out the arm cheaply, shifts edges by half a pixel and its orthographic depth does not
read linearly; a NumPy z-buffer is correct and takes tenths of a millisecond; the compiled one of
`ba_torchrl.sim.vision.kernels` gives the same numbers in hundredths.

All depth is linear and in metres, along the optical axis. Rows follow +x as far as the direction
of view allows, columns +y; a pixel stands for its centre.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ba_torchrl.sim.geometry import Quaternion, Vector, quaternion_yaw
from ba_torchrl.sim.meshes import Mesh
from ba_torchrl.sim.shapes import Decal, Shape
from ba_torchrl.sim.vision.kernels import (
    paint_square,
    rasterize_depth,
    rasterize_floor,
    rasterize_heights,
    rotate_about,
    splat,
    transform,
    unproject,
)
from ba_torchrl.sim.vision.lens import FAR_M, NEAR_M, Lens, Range


class Renderable(Protocol):
    """What a camera needs to know of a body."""

    shape: Shape
    is_hidden: bool

    @property
    def pose(self) -> tuple[Vector, Quaternion]:
        """Position (metres) and orientation (x, y, z, w) of the shape's frame."""


@dataclass(frozen=True)
class PosedShape:
    """A shape at a fixed pose that exists for cameras only."""

    shape: Shape
    pose: tuple[Vector, Quaternion]
    is_hidden: bool = False


class SceneMesh:
    """The surface of a set of bodies, wherever they are now; hidden ones do not count.

    Args:
        bodies: all that may become visible.
    """

    def __init__(self, bodies: Iterable[Renderable]) -> None:
        bodies = list(bodies)
        self._decals = [
            body for body in bodies if isinstance(body.shape, Decal) and body.shape.recess_depth_m
        ]
        self._bodies = [body for body in bodies if not isinstance(body.shape, Decal)]
        self._meshes: list[Mesh | None] = [None] * len(self._bodies)
        self._shown: list[int] | None = None
        self._vertices = self._owner = self._faces = self._poses = self._moved = np.empty(0)

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices [V, 3] in metres and faces [F, 3]; the next call overwrites them."""
        shown = [n for n, body in enumerate(self._bodies) if not body.is_hidden]
        if shown != self._shown:
            self._collect(shown)
        for row, n in zip(self._poses, shown, strict=True):
            row[:3], row[3:] = self._bodies[n].pose
        transform(self._vertices, self._owner, self._poses, self._moved)
        return self._moved, self._faces

    def recesses(self) -> np.ndarray:
        """Return the dips that decals make: x, y, half edge, cos and sin of yaw, depth; [D, 6]."""
        rows = []
        for decal in self._decals:
            if not decal.is_hidden:
                (x, y, _), turn = decal.pose
                yaw = quaternion_yaw(turn)
                half, depth = decal.shape.size_m[0] / 2, decal.shape.recess_depth_m
                rows.append((x, y, half, math.cos(yaw), math.sin(yaw), depth))
        return np.array(rows).reshape(-1, 6)

    def paint_recesses(
        self, image: np.ndarray, corner_m: tuple[float, float], pixel_m: float, yaw_rad: float
    ) -> None:
        """Write the dips into a height image seen from straight above.

        Args:
            image: [H, W], changed in place.
            corner_m: x and y of its first pixel's outer corner.
            pixel_m: edge of a pixel.
            yaw_rad: turn of the image about its centre.
        """
        reach_x, reach_y = (size * pixel_m / 2 for size in image.shape)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        for decal in self._decals:
            if decal.is_hidden:
                continue
            (x, y, _), turn = decal.pose
            dx, dy = x - corner_m[0], y - corner_m[1]
            if yaw_rad:
                dx, dy = dx - reach_x, dy - reach_y
                dx, dy = reach_x + cos * dx + sin * dy, reach_y + cos * dy - sin * dx
            paint_square(
                image,
                (dx / pixel_m, dy / pixel_m),
                decal.shape.size_m[0] / 2 / pixel_m,
                quaternion_yaw(turn) - yaw_rad,
                -decal.shape.recess_depth_m,
            )

    def _collect(self, shown: list[int]) -> None:
        """Gather the meshes of these bodies into one."""
        for n in shown:
            if self._meshes[n] is None:
                self._meshes[n] = self._bodies[n].shape.mesh()
        meshes = [self._meshes[n] for n in shown]
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        self._owner = np.repeat(np.arange(len(meshes)), np.diff(starts))
        self._vertices = np.concatenate([np.empty((0, 3)), *(mesh.vertices for mesh in meshes)])
        self._faces = np.concatenate(
            [
                np.empty((0, 3), dtype=np.int64),
                *(mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)),
            ]
        )
        self._poses = np.empty((len(meshes), 7))
        self._moved = np.empty_like(self._vertices)
        self._shown = shown


class HeightCamera:
    """Looks straight down on a set of bodies, without perspective and without the arm.

    Rows follow +x, columns +y; a pixel stands for its centre.

    Args:
        bodies: what the camera sees besides the floor (height 0).
    """

    def __init__(self, bodies: Sequence[Renderable]) -> None:
        self.surface = SceneMesh(bodies)

    def heightmap(
        self, center_m: tuple[float, float], side_m: float, pixels: int, yaw_rad: float = 0.0
    ) -> np.ndarray:
        """Return the height of what is seen.

        Args:
            center_m: x and y of the image's centre.
            side_m: width of the image.
            pixels: number of rows and columns.
            yaw_rad: turn of the camera: its rows run along (cos, sin) of this angle.

        Returns:
            [pixels, pixels] float64, metres above the floor.
        """
        image = np.zeros((pixels, pixels))
        pixel = side_m / pixels
        x0, y0 = center_m[0] - side_m / 2, center_m[1] - side_m / 2
        self.surface.paint_recesses(image, (x0, y0), pixel, yaw_rad)
        vertices, faces = self.surface.triangles()
        if yaw_rad:
            rotate_about(vertices, float(center_m[0]), float(center_m[1]), -float(yaw_rad))
        rasterize_heights(vertices, faces, x0, y0, pixel, image)
        return image


def depth_image(surfaces: Sequence[SceneMesh], lens: Lens, pixels: int) -> np.ndarray:
    """Return the depth of surfaces and floor in perspective.

    Through a dip of the floor one sees a floor that much lower.

    Args:
        surfaces: what the camera sees besides the floor.
        lens: the camera.
        pixels: number of rows and columns.

    Returns:
        [pixels, pixels] float64, metres along the optical axis, at most `FAR_M`.
    """
    recesses = _recesses(surfaces)
    return _depth(surfaces, lens, pixels, recesses)


def _recesses(surfaces: Sequence[SceneMesh]) -> np.ndarray:
    return np.concatenate([np.empty((0, 6)), *(surface.recesses() for surface in surfaces)])


def _depth(
    surfaces: Sequence[SceneMesh], lens: Lens, pixels: int, recesses: np.ndarray
) -> np.ndarray:
    image = np.empty((pixels, pixels))
    eye, focal = np.array(lens.eye_m, dtype=float), lens.focal_px(pixels)
    rasterize_floor(eye, lens.axes, focal, FAR_M, recesses, image)
    for surface in surfaces:
        vertices, faces = surface.triangles()
        rasterize_depth(vertices, faces, eye, lens.axes, focal, NEAR_M, image)
    return image


def visible_points(
    surfaces: Sequence[SceneMesh],
    lenses: Sequence[Lens],
    pixels: int,
    bounds_m: tuple[Range, Range, Range],
) -> np.ndarray:
    """Return the points of surfaces and floor that cameras see, one for each of their pixels.

    Points of the floor inside a dip are sunk straight down by its depth.

    Args:
        surfaces: what the cameras see besides the floor.
        lenses: the cameras.
        pixels: rows and columns of each.
        bounds_m: ranges of x, y and z that points must lie in.

    Returns:
        [N, 3] float64, metres; camera by camera and row by row.
    """
    recesses = _recesses(surfaces)
    low, high = np.array(bounds_m, dtype=float).T.copy()
    points = np.empty((len(lenses) * pixels * pixels, 3))
    count = 0
    for lens in lenses:
        depth = _depth(surfaces, lens, pixels, np.empty((0, 6)))
        eye = np.array(lens.eye_m, dtype=float)
        count = unproject(
            depth, eye, lens.axes, lens.focal_px(pixels), recesses, low, high, points, count
        )
    return points[:count]


def point_cloud(
    surfaces: Sequence[SceneMesh],
    lenses: Sequence[Lens],
    count: int,
    bounds_m: tuple[Range, Range, Range],
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Return a given number of the points that cameras see, floor included.

    They are drawn without replacement; where fewer are seen than asked for, all of them are there
    and some repeat. Without a generator the draw is always the same, so that the cloud follows
    from the scene alone.

    Args:
        surfaces: what the cameras see besides the floor.
        lenses: the cameras, such as `side_lenses`.
        count: number of points.
        bounds_m: ranges of x, y and z; what is below the range of z counts as well, such as the
            floor of a workspace that starts above it.
        rng: draws the points; None stands for a fixed seed.

    Returns:
        [count, 3] float32, metres.

    Raises:
        ValueError: the cameras see nothing inside the bounds.
    """
    pixels = min(max(math.ceil(math.sqrt(2 * count)), 128), 512)
    x, y, z = bounds_m
    points = visible_points(surfaces, lenses, pixels, (x, y, (-math.inf, z[1])))
    seen = len(points)
    if not seen:
        raise ValueError(f"the cameras see nothing inside {bounds_m} m")
    rng = np.random.default_rng(0) if rng is None else rng
    whole, rest = divmod(count, seen)
    chosen = np.concatenate(
        [np.tile(np.arange(seen), whole), rng.choice(seen, rest, replace=False, shuffle=False)]
    )
    return points[chosen].astype(np.float32)


def splat_heightmap(
    points: np.ndarray, center_m: tuple[float, float], side_m: float, pixels: int
) -> np.ndarray:
    """Return the height of points seen from straight above; gaps take the nearest pixel's.

    Args:
        points: [N, 3] float64, metres.
        center_m: x and y of the image's centre.
        side_m: width of the image.
        pixels: number of rows and columns.

    Returns:
        [pixels, pixels] float64, metres above the floor.
    """
    image = np.zeros((pixels, pixels))
    x0, y0 = center_m[0] - side_m / 2, center_m[1] - side_m / 2
    splat(points, len(points), x0, y0, side_m / pixels, image)
    return image
