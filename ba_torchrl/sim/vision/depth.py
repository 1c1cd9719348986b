"""Depth images, height images and point clouds, rasterised from the meshes of the bodies.

PyBullet's TinyRenderer is not used: it takes milliseconds for 128 x 128 pixels and four cubes,
cannot omit the arm at low cost, shifts edges by half a pixel, and its orthographic depth is not
linear. The compiled kernels take hundredths of a millisecond (`recipes/measure.py` measures both).

Depth is linear, in metres, along the optical axis. Image rows follow +x as far as the viewing
direction allows, columns +y. Pixels are sampled at their centres.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from ba_torchrl.sim.geometry import Pose, quaternion_yaw
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

_NONE = np.empty((0, 3))


class Renderable(Protocol):
    """The part of the interface of `Body` that cameras use."""

    shape: Shape
    is_hidden: bool

    @property
    def pose(self) -> Pose:
        """Pose of the frame of the shape in the world."""


@dataclass(frozen=True)
class PosedShape:
    """A shape at a fixed pose, visible to cameras but not simulated."""

    shape: Shape
    pose: Pose
    is_hidden: bool = False


class SceneMesh:
    """Triangle mesh of the bodies of a set that are visible, at their current poses."""

    def __init__(self, bodies: Iterable[Renderable]) -> None:
        bodies = list(bodies)
        self._decals = [
            body for body in bodies if isinstance(body.shape, Decal) and body.shape.recess_depth_m
        ]
        self._bodies = [body for body in bodies if not isinstance(body.shape, Decal)]
        self._meshes: list[Mesh | None] = [None] * len(self._bodies)
        self._shown: list[int] | None = None
        self._poses: list[Pose] | None = None
        self._decal_poses: list[Pose | None] | None = None
        self._local_vertices = self._owner = np.empty(0)
        self.vertices = self.faces = np.empty(0)
        """The mesh at the last `refresh`: vertices [V, 3] in metres and faces [F, 3]."""

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices [V, 3] in metres and faces [F, 3]; not to be modified.

        The next call may overwrite both.
        """
        self.refresh()
        return self.vertices, self.faces

    def refresh(self) -> bool:
        """Update the mesh; return whether it or a decal has changed since the last call."""
        shown = [n for n, body in enumerate(self._bodies) if not body.is_hidden]
        poses = [self._bodies[n].pose for n in shown]
        decal_poses = [None if decal.is_hidden else decal.pose for decal in self._decals]
        has_moved = shown != self._shown or poses != self._poses
        if shown != self._shown:
            self._collect(shown)
        if has_moved:
            rows = np.array(
                [(*position, *orientation) for position, orientation in poses], dtype=float
            )
            transform(self._local_vertices, self._owner, rows.reshape(-1, 7), self.vertices)
        is_changed = has_moved or decal_poses != self._decal_poses
        self._poses, self._decal_poses = poses, decal_poses
        return is_changed

    def recesses(self) -> np.ndarray:
        """Return the recesses of the visible decals, [R, 6] float64.

        They are x, y and half edge (metres), cos and sin of the yaw, and depth (metres).
        """
        rows = []
        for decal in self._decals:
            if not decal.is_hidden:
                (x, y, _), orientation = decal.pose
                yaw = quaternion_yaw(orientation)
                half, depth = decal.shape.size_m[0] / 2, decal.shape.recess_depth_m
                rows.append((x, y, half, math.cos(yaw), math.sin(yaw), depth))
        return np.array(rows).reshape(-1, 6)

    def paint_recesses(
        self, image: np.ndarray, corner_m: tuple[float, float], pixel_m: float, yaw_rad: float
    ) -> None:
        """Paint the recesses of the visible decals into an orthographic height image.

        ``corner_m`` is the outer corner of pixel (0, 0), before the rotation about the centre.
        """
        half_x, half_y = (size * pixel_m / 2 for size in image.shape)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        for decal in self._decals:
            if decal.is_hidden:
                continue
            (x, y, _), orientation = decal.pose
            dx, dy = x - corner_m[0], y - corner_m[1]
            if yaw_rad:
                dx, dy = dx - half_x, dy - half_y
                dx, dy = half_x + cos * dx + sin * dy, half_y + cos * dy - sin * dx
            paint_square(
                image,
                (dx / pixel_m, dy / pixel_m),
                decal.shape.size_m[0] / 2 / pixel_m,
                quaternion_yaw(orientation) - yaw_rad,
                -decal.shape.recess_depth_m,
            )

    def _collect(self, shown: list[int]) -> None:
        """Concatenate the meshes of some bodies."""
        for n in shown:
            if self._meshes[n] is None:
                self._meshes[n] = self._bodies[n].shape.mesh()
        meshes = [self._meshes[n] for n in shown]
        counts = [len(mesh.vertices) for mesh in meshes]
        starts = [0, *itertools.accumulate(counts)][: len(meshes)]
        self._owner = np.repeat(np.arange(len(meshes)), counts)
        self._local_vertices = np.concatenate([_NONE, *(mesh.vertices for mesh in meshes)])
        faces = np.concatenate([_NONE.astype(np.int64), *(mesh.faces for mesh in meshes)])
        offsets = np.repeat(starts, [len(mesh.faces) for mesh in meshes]).astype(np.int64)
        self.faces = faces + offsets[:, None]
        self.vertices = np.empty_like(self._local_vertices)
        self._shown = shown


class _TopView(NamedTuple):
    """The square that an orthographic height image shows."""

    center_m: tuple[float, float]
    side_m: float
    pixels: int
    yaw_rad: float

    def floor(self) -> np.ndarray:
        """Return the height image of the floor."""
        return np.zeros((self.pixels, self.pixels))


class _Layer:
    """Bodies drawn over a height image."""

    def __init__(self, bodies: Iterable[Renderable]) -> None:
        self._mesh = SceneMesh(bodies)
        self._view: _TopView | None = None
        self._below: np.ndarray | None = None
        self._image = _NONE

    def image(self, view: _TopView, below: np.ndarray | None) -> np.ndarray:
        """Return a height image [pixels, pixels] with the bodies, drawn again only after a change.

        They are drawn over the image ``below``; None is the floor.
        """
        is_changed = self._mesh.refresh()
        if is_changed or view != self._view or below is not self._below:
            self._view, self._below = view, below
            self._image = view.floor() if below is None else below.copy()
            self._rasterize(view, self._image)
        return self._image

    def draw(self, view: _TopView, image: np.ndarray) -> None:
        """Draw the bodies over an image [pixels, pixels] that is not kept."""
        self._view = None  # the next call of `image` does not see the changes since the last one
        self._mesh.refresh()
        self._rasterize(view, image)

    def _rasterize(self, view: _TopView, image: np.ndarray) -> None:
        (x, y), side_m, pixels, yaw = view
        pixel = side_m / pixels
        x0, y0 = x - side_m / 2, y - side_m / 2
        self._mesh.paint_recesses(image, (x0, y0), pixel, yaw)
        vertices = self._mesh.vertices
        if yaw:
            vertices = vertices.copy()
            rotate_about(vertices, float(x), float(y), -float(yaw))
        rasterize_heights(vertices, self._mesh.faces, x0, y0, pixel, image)


class HeightCamera:
    """An orthographic camera that looks straight down on a set of bodies, but not on the robot.

    While the view is the same, static bodies are drawn again only when they are placed, and an
    unchanged scene is not drawn again.

    Args:
        bodies: what is visible besides the floor, which has height 0.
    """

    def __init__(self, bodies: Sequence[Renderable]) -> None:
        self.mesh = SceneMesh(bodies)
        static = [body for body in bodies if body.shape.mass_kg == 0]
        moving = [body for body in bodies if body.shape.mass_kg > 0]
        self._layers = [_Layer(layer) for layer in (static, moving) if layer]
        self._view: _TopView | None = None

    def heightmap(
        self, center_m: tuple[float, float], side_m: float, pixels: int, yaw_rad: float = 0.0
    ) -> np.ndarray:
        """Render a height image, [pixels, pixels] float64 metres above the floor.

        It shows a square with the edge ``side_m``; ``yaw_rad`` is the heading of its rows, 0 is +x.
        """
        view = _TopView(tuple(center_m), side_m, pixels, yaw_rad)
        if view != self._view or not self._layers:
            self._view, image = view, view.floor()
            for layer in self._layers:
                layer.draw(view, image)
            return image
        below = None
        for layer in self._layers:
            below = layer.image(view, below)
        return below.copy()


def depth_image(
    meshes: Sequence[SceneMesh], lens: Lens, pixels: int, *, recesses: bool = True
) -> np.ndarray:
    """Render depths along the optical axis, [pixels, pixels] float64 metres, at most `FAR_M`."""
    image = np.empty((pixels, pixels))
    eye, focal = np.array(lens.eye_m, dtype=float), lens.focal_px(pixels)
    rasterize_floor(eye, lens.axes, focal, FAR_M, _recesses(meshes if recesses else ()), image)
    for mesh in meshes:
        vertices, faces = mesh.triangles()
        rasterize_depth(vertices, faces, eye, lens.axes, focal, NEAR_M, image)
    return image


def _recesses(meshes: Sequence[SceneMesh]) -> np.ndarray:
    return np.concatenate([np.empty((0, 6)), *(mesh.recesses() for mesh in meshes)])


def visible_points(
    meshes: Sequence[SceneMesh],
    lenses: Sequence[Lens],
    pixels: int,
    bounds_m: tuple[Range, Range, Range],
) -> np.ndarray:
    """Return the points [N, 3] that perspective cameras see, one for each pixel of each camera.

    They are ordered by camera, row and column, in metres. Points of the floor inside a recess are
    moved down by its depth, and those outside of ``bounds_m``, ranges of x, y and z, are omitted.
    """
    recesses = _recesses(meshes)
    low, high = np.array(bounds_m, dtype=float).T.copy()
    points = np.empty((len(lenses) * pixels * pixels, 3))
    count = 0
    for lens in lenses:
        depth = depth_image(meshes, lens, pixels, recesses=False)
        eye = np.array(lens.eye_m, dtype=float)
        count = unproject(
            depth, eye, lens.axes, lens.focal_px(pixels), recesses, low, high, points, count
        )
    return points[:count]


def point_cloud(
    meshes: Sequence[SceneMesh],
    lenses: Sequence[Lens],
    count: int,
    bounds_m: tuple[Range, Range, Range],
) -> np.ndarray:
    """Return a random sample [count, 3] float32 of the points that cameras see, metres.

    The points are drawn without replacement; if there are fewer than ``count``, each is repeated
    equally often, up to one. Those outside of ``bounds_m``, ranges of x, y and z, are omitted; the
    lower bound of z is ignored, so that the floor is included where the workspace starts above it.
    The same scene gives the same points.
    """
    pixels = min(max(math.ceil(math.sqrt(2 * count)), 128), 512)
    x, y, z = bounds_m
    points = visible_points(meshes, lenses, pixels, (x, y, (-math.inf, z[1])))
    n = len(points)
    if not n:
        raise ValueError(f"the cameras see nothing inside {bounds_m} m")
    rng = np.random.default_rng(0)
    repeats, rest = divmod(count, n)
    chosen = np.concatenate(
        [np.tile(np.arange(n), repeats), rng.choice(n, rest, replace=False, shuffle=False)]
    )
    return points[chosen].astype(np.float32)


def splat_heightmap(
    points: np.ndarray, center_m: tuple[float, float], side_m: float, pixels: int
) -> np.ndarray:
    """Return the orthographic height image [pixels, pixels] of points [N, 3], metres.

    Pixels without points take the value of the nearest pixel with points.
    """
    image = np.zeros((pixels, pixels))
    x0, y0 = center_m[0] - side_m / 2, center_m[1] - side_m / 2
    splat(points, len(points), x0, y0, side_m / pixels, image)
    return image
