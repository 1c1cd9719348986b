"""Colour images with the robot, rendered by PyBullet's TinyRenderer.

TinyRenderer's own shadows are correct only for some camera poses, have hard edges and double the
time. Images for people use a shadow map instead: a small image of the scene rendered from the
light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pybullet

from ba_torchrl.sim.geometry import Vector
from ba_torchrl.sim.shapes import Decal
from ba_torchrl.sim.vision.in_hand import bilinear
from ba_torchrl.sim.vision.lens import Lens
from ba_torchrl.sim.world import World

RGBD_RANGE_M = (0.1, 5.0)
"""Near and far plane of `render_rgbd`."""

DEFAULT_FLOOR_RGB = (0.95, 0.95, 0.93)

_LIGHT_DIRECTION: Vector = (0.30, -0.35, 1.0)
"""Direction from the scene towards the light."""
_LIGHT_DISTANCE_M = 4.0
"""Distance of the light; TinyRenderer does not support directional light."""
_SHADOW_WIDTH_M = 2.0
"""Edge of the square that the shadow map shows."""
_SHADOW_PIXELS = 240
_SHADOW_BLUR = 2
"""Half width of the blur of the shadow map, pixels."""
_SHADOW_DEPTH = 0.3
"""Fraction by which full shadow darkens the floor."""
FOV_DEG = 28.0
"""Vertical field of view of `render_rgb`."""


class Viewpoint(NamedTuple):
    """A camera pose that looks at a target."""

    target_m: Vector
    """Point at the centre of the image."""
    distance_m: float
    """From the target to the camera."""
    yaw_deg: float
    pitch_deg: float
    """Negative angles look down."""

    def view_matrix(self) -> tuple[float, ...]:
        """Return PyBullet's view matrix."""
        return pybullet.computeViewMatrixFromYawPitchRoll(*self, 0.0, 2)


def fit_viewpoint(
    points_m: np.ndarray,
    yaw_deg: float,
    pitch_deg: float,
    fov_deg: float,
    aspect: float,
    margin: float = 0.0,
) -> Viewpoint:
    """Return the nearest camera pose at which an image of a perspective camera shows all points.

    Where the image is wider than the points [N, 3], they are near its centre. Where it is higher,
    the lowest point is at the lower margin, which leaves space for the arm above. The margin is a
    fraction of the width and height of the image.
    """
    view = Viewpoint((0.0, 0.0, 0.0), 1.0, yaw_deg, pitch_deg).view_matrix()
    axes = np.reshape(view, (4, 4)).T[:3, :3]  # rows: right, up, backward
    right, up, backward = axes @ np.asarray(points_m, dtype=float).T
    half_height = (1 - 2 * margin) * math.tan(math.radians(fov_deg) / 2)
    half_width = half_height * aspect
    # In camera axes with the camera at c, the right edge requires
    # right - c_right <= half_width * (c_backward - backward); the other edges are similar.
    to_right = (right + half_width * backward).max()
    to_left = (half_width * backward - right).max()
    to_top = (up + half_height * backward).max()
    to_bottom = (half_height * backward - up).max()
    c_backward = max(
        (to_right + to_left) / (2 * half_width), (to_top + to_bottom) / (2 * half_height)
    )
    camera = np.array([(to_right - to_left) / 2, half_height * c_backward - to_bottom, c_backward])
    distance = float(c_backward - (backward.min() + backward.max()) / 2)
    target = (camera - (0.0, 0.0, distance)) @ axes
    return Viewpoint(tuple(target.tolist()), distance, yaw_deg, pitch_deg)


def render_rgb(
    world: World,
    viewpoint: Viewpoint,
    width: int = 480,
    height: int = 360,
    floor_rgb: tuple[float, float, float] | None = DEFAULT_FLOOR_RGB,
) -> np.ndarray:
    """Render the scene with the robot and shadows on the floor, [height, width, 3] uint8.

    The components of the floor's colour are from 0 to 1; None keeps PyBullet's.
    """
    view = viewpoint.view_matrix()
    projection = pybullet.computeProjectionMatrixFOV(FOV_DEG, width / height, 0.05, 10.0)
    rgb, _, segmentation = _render(world, width, height, view, projection, links=True)
    owner = np.where(segmentation >= 0, segmentation & 0xFFFFFF, -1)
    image = rgb.astype(np.float32)
    floor = owner == world.floor
    if floor_rgb is not None:
        image[floor] = np.multiply(floor_rgb, 255.0)
    flat = np.isin(owner, [world.floor, *_decals(world)])
    rows, cols = np.nonzero(flat)
    points = _floor_points(view, width, height, rows, cols)
    shadow = _shadow(world, viewpoint.target_m, points)
    image[rows, cols] *= (1 - _SHADOW_DEPTH * shadow)[:, None]
    return _smooth_edges(image, segmentation).round().astype(np.uint8)


def render_rgbd(
    world: World, lens: Lens, pixels: int, range_m: tuple[float, float] = RGBD_RANGE_M
) -> tuple[np.ndarray, np.ndarray]:
    """Render colours and depths of the scene with the robot.

    They are [pixels, pixels, 3] uint8, and [pixels, pixels] float64 metres along the optical axis,
    between the near and the far plane of ``range_m``.
    """
    near, far = range_m
    rgb, buffer, _ = _render(world, pixels, pixels, *_matrices(lens, range_m))
    return rgb, far * near / (far - (far - near) * buffer.astype(float))


def render_owners(world: World, lens: Lens, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Render PyBullet's ids of body and link in each pixel of `render_rgbd`.

    Both are [pixels, pixels] int32. The body is -1 where there is none, the link -1 for a base.
    """
    matrices = _matrices(lens, RGBD_RANGE_M)
    _, _, segmentation = _render(world, pixels, pixels, *matrices, links=True)
    is_body = segmentation >= 0
    bodies = np.where(is_body, segmentation & 0xFFFFFF, -1)
    return bodies, np.where(is_body, (segmentation >> 24) - 1, -1)


def _matrices(lens: Lens, range_m: tuple[float, float]) -> tuple[Sequence[float], Sequence[float]]:
    """Return PyBullet's view and projection matrix."""
    return (
        pybullet.computeViewMatrix(lens.eye_m, lens.target_m, (-lens.axes[0]).tolist()),
        pybullet.computeProjectionMatrixFOV(math.degrees(lens.fov_rad), 1.0, *range_m),
    )


def _render(
    world: World,
    width: int,
    height: int,
    view: Sequence[float],
    projection: Sequence[float],
    *,
    links: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render an image with TinyRenderer.

    Return colours [H, W, 3] uint8, PyBullet's depth buffer [H, W] and the segmentation [H, W]:
    PyBullet's body id, or -1 for none. With ``links``, the bits from 24 on are the link index plus
    one.
    """
    projection = list(projection)
    # TinyRenderer samples pixels half a pixel away from their centres
    projection[8] += 1 / width
    projection[9] += 1 / height
    _, _, rgba, buffer, segmentation = pybullet.getCameraImage(
        width,
        height,
        view,
        projection,
        shadow=0,
        lightDirection=_LIGHT_DIRECTION,
        lightAmbientCoeff=0.6,
        lightDiffuseCoeff=0.45,
        lightSpecularCoeff=0.05,
        flags=pybullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX if links else 0,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=world.client,
    )
    rgb = np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[..., :3].copy()
    return rgb, np.reshape(buffer, (height, width)), np.reshape(segmentation, (height, width))


def _decals(world: World) -> list[int]:
    return [body.id for body in world.bodies if isinstance(body.shape, Decal)]


def _floor_points(
    view: Sequence[float], width: int, height: int, rows: np.ndarray, cols: np.ndarray
) -> np.ndarray:
    """Return x and y [N, 2] of the points of the floor that pixels show, metres."""
    pose = np.reshape(view, (4, 4)).T
    rotation = pose[:3, :3]  # rows: right, up, backward
    eye = -rotation.T @ pose[:3, 3]
    edge = math.tan(math.radians(FOV_DEG) / 2)
    right = (2 * (cols + 0.5) / width - 1) * edge * width / height
    up = (1 - 2 * (rows + 0.5) / height) * edge
    rays = right[:, None] * rotation[0] + up[:, None] * rotation[1] - rotation[2]
    return eye[:2] + rays[:, :2] * (eye[2] / np.maximum(-rays[:, 2:], 1e-6))


def _shadow(world: World, target_m: Vector, points: np.ndarray) -> np.ndarray:
    """Return the share of the light, 0 to 1, that is blocked at points [N, 2] of the floor."""
    size, half = _SHADOW_PIXELS, _SHADOW_WIDTH_M / 2
    toward = np.array(_LIGHT_DIRECTION) / np.linalg.norm(_LIGHT_DIRECTION)
    right = np.cross((1.0, 0.0, 0.0), toward)
    right /= np.linalg.norm(right)
    up = np.cross(toward, right)
    center = np.array([target_m[0], target_m[1], 0.0])
    light = center + _LIGHT_DISTANCE_M * toward
    view = pybullet.computeViewMatrix(light.tolist(), center.tolist(), up.tolist())
    fov = 2 * math.degrees(math.atan(half / _LIGHT_DISTANCE_M))
    projection = pybullet.computeProjectionMatrixFOV(fov, 1.0, 1.0, 2 * _LIGHT_DISTANCE_M)
    _, _, owner = _render(world, size, size, view, projection)
    blocked = ~np.isin(owner, [-1, world.floor, *_decals(world)])
    soft = _blurred(_blurred(blocked.astype(np.float32)))
    offset = np.pad(points, ((0, 0), (0, 1))) - light
    scale = size / _SHADOW_WIDTH_M * _LIGHT_DISTANCE_M / -(offset @ toward)
    col = np.clip(size / 2 + offset @ right * scale - 0.5, 0, size - 1.001)
    row = np.clip(size / 2 - offset @ up * scale - 0.5, 0, size - 1.001)
    return bilinear(soft, row, col)


def _blurred(image: np.ndarray) -> np.ndarray:
    """Return an image [H, W] after a box filter of `_SHADOW_BLUR`."""
    size = 2 * _SHADOW_BLUR + 1
    for axis in (0, 1):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (_SHADOW_BLUR + 1, _SHADOW_BLUR)
        total = np.cumsum(np.pad(image, pad), axis=axis)
        ends = np.arange(size, total.shape[axis])
        image = (total.take(ends, axis) - total.take(ends - size, axis)) / size
    return image


def _smooth_edges(image: np.ndarray, segmentation: np.ndarray) -> np.ndarray:
    """Return an image with the borders between its segments blurred (anti-aliasing)."""
    edge = np.zeros(segmentation.shape, dtype=bool)
    for axis in (0, 1):
        differs = np.diff(segmentation, axis=axis) != 0
        low = tuple(slice(None, -1) if a == axis else slice(None) for a in (0, 1))
        high = tuple(slice(1, None) if a == axis else slice(None) for a in (0, 1))
        edge[low] |= differs
        edge[high] |= differs
    rows, cols = np.nonzero(edge)
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    mixed = np.zeros((len(rows), 3), dtype=np.float32)
    for i, a in enumerate((0.25, 0.5, 0.25)):
        for j, b in enumerate((0.25, 0.5, 0.25)):
            mixed += a * b * padded[rows + i, cols + j]
    smooth = image.copy()
    smooth[rows, cols] = mixed
    return smooth
