"""Colour images with the robot, rendered by PyBullet's TinyRenderer.

TinyRenderer's own shadows are correct only for some camera poses, have hard edges and double the
time. Images for people use a shadow map instead: a small image of the scene rendered from the
light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pybullet

from ba_torchrl.sim.geometry import Vector
from ba_torchrl.sim.shapes import Decal
from ba_torchrl.sim.vision.framing import Viewpoint
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


def render_rgb(
    world: World,
    viewpoint: Viewpoint,
    width: int = 480,
    height: int = 360,
    floor_rgb: tuple[float, float, float] | None = DEFAULT_FLOOR_RGB,
) -> np.ndarray:
    """Render the scene with the robot, in colour and with shadows on the floor.

    Args:
        world: the scene.
        viewpoint: pose of the camera.
        width: number of columns.
        height: number of rows.
        floor_rgb: colour of the floor, each component from 0 to 1; None keeps that of PyBullet.

    Returns:
        [height, width, 3] uint8.
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


def render_rgbd(world: World, lens: Lens, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Render a colour and a depth image of the scene with the robot.

    Args:
        world: the scene.
        lens: the camera, such as `ba_torchrl.sim.vision.lens.oblique_lens`.
        pixels: number of rows and columns.

    Returns:
        Colours, [pixels, pixels, 3] uint8, and depths along the optical axis, [pixels, pixels]
        float64 metres, at most the far plane of `RGBD_RANGE_M`.
    """
    near, far = RGBD_RANGE_M
    view = pybullet.computeViewMatrix(lens.eye_m, lens.target_m, (-lens.axes[0]).tolist())
    projection = pybullet.computeProjectionMatrixFOV(math.degrees(lens.fov_rad), 1.0, near, far)
    rgb, buffer, _ = _render(world, pixels, pixels, view, projection)
    return rgb, far * near / (far - (far - near) * buffer.astype(float))


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

    Args:
        world: the scene.
        width: number of columns.
        height: number of rows.
        view: PyBullet's view matrix.
        projection: PyBullet's projection matrix.
        links: distinguish the links of a body in the segmentation.

    Returns:
        Colours [H, W, 3] uint8, PyBullet's depth buffer [H, W] and the segmentation [H, W]:
        PyBullet's body id, or -1 for none. With ``links``, the bits from 24 on are the link index
        plus one.
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
    """Return the points of the floor that pixels show.

    Args:
        view: PyBullet's view matrix.
        width: number of columns of the image.
        height: number of rows of the image.
        rows: [N] of the pixels.
        cols: [N] of the pixels.

    Returns:
        [N, 2] x and y, metres.
    """
    pose = np.reshape(view, (4, 4)).T
    rotation = pose[:3, :3]  # rows: right, up, backward
    eye = -rotation.T @ pose[:3, 3]
    edge = math.tan(math.radians(FOV_DEG) / 2)
    right = (2 * (cols + 0.5) / width - 1) * edge * width / height
    up = (1 - 2 * (rows + 0.5) / height) * edge
    rays = right[:, None] * rotation[0] + up[:, None] * rotation[1] - rotation[2]
    return eye[:2] + rays[:, :2] * (eye[2] / np.maximum(-rays[:, 2:], 1e-6))


def _shadow(world: World, target_m: Vector, points: np.ndarray) -> np.ndarray:
    """Return the fraction of the light that is blocked at points of the floor.

    Args:
        world: the scene.
        target_m: point at the centre of the image.
        points: [N, 2] x and y, metres.

    Returns:
        [N] from 0 (lit) to 1 (full shadow).
    """
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
    i, j = row.astype(int), col.astype(int)
    u, v = row - i, col - j
    return (
        (1 - u) * (1 - v) * soft[i, j]
        + u * (1 - v) * soft[i + 1, j]
        + (1 - u) * v * soft[i, j + 1]
        + u * v * soft[i + 1, j + 1]
    )


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
    """Return an image with the borders between its segments blurred (anti-aliasing).

    Args:
        image: [H, W, 3] colours.
        segmentation: [H, W] from `_render`.
    """
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
