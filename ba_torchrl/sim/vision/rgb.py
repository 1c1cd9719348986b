"""Pictures in colour, arm included, drawn by PyBullet's TinyRenderer.

Its own shadows work only close to where it expects the camera, have hard edges and double the time.
Pictures for people get theirs from a second, small drawing: the scene as the light sees it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pybullet

from ba_torchrl.sim.geometry import Vector
from ba_torchrl.sim.shapes import Decal
from ba_torchrl.sim.vision.lens import Lens
from ba_torchrl.sim.world import World

RGBD_RANGE_M = (0.1, 5.0)
"""Near and far end of what `render_rgbd` shows."""

DEFAULT_FLOOR_RGB = (0.95, 0.95, 0.93)

_LIGHT_DIRECTION: Vector = (0.30, -0.35, 1.0)
"""Direction towards the light."""
_LIGHT_DISTANCE_M = 4.0
"""Distance of the lamp; TinyRenderer has no use for one infinitely far."""
_SHADOW_WIDTH_M = 2.0
_SHADOW_PIXELS = 240
_SHADOW_BLUR = 2
_SHADOW_DEPTH = 0.3
_FOV_DEG = 40.0


def render_rgb(
    world: World,
    target_m: Vector,
    width: int = 480,
    height: int = 360,
    distance_m: float = 1.05,
    yaw_deg: float = 62.0,
    pitch_deg: float = -27.0,
    floor_rgb: tuple[float, float, float] | None = DEFAULT_FLOOR_RGB,
) -> np.ndarray:
    """Return a picture of the whole scene, arm included, for people to look at.

    Args:
        world: what to draw.
        target_m: the point in the picture's centre.
        width: pixels across.
        height: pixels down.
        distance_m: from the target to the camera; the picture covers 0.73 times that from top to
            bottom.
        yaw_deg: camera's turn about z.
        pitch_deg: camera's pitch; negative looks down.
        floor_rgb: colour of the floor in the picture, each component from 0 to 1; None leaves it
            as PyBullet draws it.

    Returns:
        [height, width, 3] uint8.
    """
    view = pybullet.computeViewMatrixFromYawPitchRoll(
        target_m, distance_m, yaw_deg, pitch_deg, 0, 2
    )
    projection = pybullet.computeProjectionMatrixFOV(_FOV_DEG, width / height, 0.05, 10.0)
    rgb, _, parts = _render(world, width, height, view, projection, links=True)
    owner = np.where(parts >= 0, parts & 0xFFFFFF, -1)
    image = rgb.astype(np.float32)
    floor = owner == world.floor
    if floor_rgb is not None:
        image[floor] = np.multiply(floor_rgb, 255.0)
    flat = np.isin(owner, [world.floor, *_decals(world)])
    rows, cols = np.nonzero(flat)
    points = _floor_points(view, width, height, rows, cols)
    shade = _shadow(world, target_m, points)
    image[rows, cols] *= (1 - _SHADOW_DEPTH * shade)[:, None]
    return _smooth_edges(image, parts).round().astype(np.uint8)


def render_rgbd(world: World, lens: Lens, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what a camera sees in colour and its depth, arm included, drawn by PyBullet.

    Args:
        world: what to draw.
        lens: the camera, such as `ba_torchrl.sim.vision.lens.oblique_lens`.
        pixels: number of rows and columns.

    Returns:
        [pixels, pixels, 3] uint8, and [pixels, pixels] float64 metres along the optical axis, at
        most the end of `RGBD_RANGE_M`.
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
    """Return colours [H, W, 3] uint8, PyBullet's depth buffer [H, W], and what is where [H, W].

    The last holds PyBullet's body ids and -1 for none; with ``links``, the link plus one is in
    its upper eight bits.
    """
    projection = list(projection)
    # TinyRenderer samples half a pixel off the pixels' centres
    projection[8] += 1 / width
    projection[9] += 1 / height
    _, _, rgba, buffer, parts = pybullet.getCameraImage(
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
    return rgb, np.reshape(buffer, (height, width)), np.reshape(parts, (height, width))


def _decals(world: World) -> list[int]:
    return [body.id for body in world.bodies if isinstance(body.shape, Decal)]


def _floor_points(
    view: Sequence[float], width: int, height: int, rows: np.ndarray, cols: np.ndarray
) -> np.ndarray:
    """Return where on the floor these pixels look, [N, 2] metres."""
    pose = np.reshape(view, (4, 4)).T
    turn = pose[:3, :3]  # rows: right, up, backward
    eye = -turn.T @ pose[:3, 3]
    edge = math.tan(math.radians(_FOV_DEG) / 2)
    right = (2 * (cols + 0.5) / width - 1) * edge * width / height
    up = (1 - 2 * (rows + 0.5) / height) * edge
    rays = right[:, None] * turn[0] + up[:, None] * turn[1] - turn[2]
    return eye[:2] + rays[:, :2] * (eye[2] / np.maximum(-rays[:, 2:], 1e-6))


def _shadow(world: World, target_m: Vector, points: np.ndarray) -> np.ndarray:
    """Return how much of the light is blocked at points [N, 2] of the floor, 0 to 1."""
    size, reach = _SHADOW_PIXELS, _SHADOW_WIDTH_M / 2
    toward = np.array(_LIGHT_DIRECTION) / np.linalg.norm(_LIGHT_DIRECTION)
    right = np.cross((1.0, 0.0, 0.0), toward)
    right /= np.linalg.norm(right)
    up = np.cross(toward, right)
    middle = np.array([target_m[0], target_m[1], 0.0])
    lamp = middle + _LIGHT_DISTANCE_M * toward
    view = pybullet.computeViewMatrix(lamp.tolist(), middle.tolist(), up.tolist())
    fov = 2 * math.degrees(math.atan(reach / _LIGHT_DISTANCE_M))
    projection = pybullet.computeProjectionMatrixFOV(fov, 1.0, 1.0, 2 * _LIGHT_DISTANCE_M)
    _, _, owner = _render(world, size, size, view, projection)
    blocked = ~np.isin(owner, [-1, world.floor, *_decals(world)])
    soft = _blurred(_blurred(blocked.astype(np.float32)))
    offset = np.pad(points, ((0, 0), (0, 1))) - lamp
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
    """Return the mean over a square window around each pixel of an image [H, W]."""
    size = 2 * _SHADOW_BLUR + 1
    for axis in (0, 1):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (_SHADOW_BLUR + 1, _SHADOW_BLUR)
        total = np.cumsum(np.pad(image, pad), axis=axis)
        ends = np.arange(size, total.shape[axis])
        image = (total.take(ends, axis) - total.take(ends - size, axis)) / size
    return image


def _smooth_edges(image: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Return the picture with the borders between its parts blended, as finer pixels would be."""
    edge = np.zeros(parts.shape, dtype=bool)
    for axis in (0, 1):
        differs = np.diff(parts, axis=axis) != 0
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
