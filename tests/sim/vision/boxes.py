"""Boxes at random poses, and their depth by ray casting."""

import math

import numpy as np

from ba_torchrl.sim.geometry import rotation_array
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.depth import PosedShape
from ba_torchrl.sim.vision.lens import FAR_M

CENTER = (0.45, 0.0)


def placed(size, position, turn=(0.0, 0.0, 0.0, 1.0)):
    return PosedShape(Box(size_m=size), (position, turn))


def random_boxes(rng, count, span=0.15):
    boxes = []
    for _ in range(count):
        turn = rng.normal(size=4)
        position = (*(np.array(CENTER) + rng.uniform(-span, span, 2)), rng.uniform(0.06, 0.12))
        boxes.append(
            placed(
                tuple(rng.uniform(0.02, 0.06, 3)),
                tuple(map(float, position)),
                tuple(map(float, turn / np.linalg.norm(turn))),
            )
        )
    return boxes


def rays_of(lens, pixels):
    """Return the ray of each pixel, scaled to length one along the optical axis."""
    forward = np.array(lens.target_m) - lens.eye_m
    forward /= np.linalg.norm(forward)
    columns = np.cross([1.0, 0.0, 0.0], forward)
    columns /= np.linalg.norm(columns)
    rows = np.cross(forward, columns)
    steps = ((np.arange(pixels) + 0.5) / pixels * 2 - 1) * math.tan(lens.fov_rad / 2)
    return forward + steps[:, None, None] * rows + steps[:, None] * columns


def ray_depths(boxes, lens, pixels):
    """Return depth by ray casting: slabs of each box in its own frame, and the floor."""
    rays, eye = rays_of(lens, pixels), np.array(lens.eye_m)
    with np.errstate(divide="ignore"):
        depth = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        for box in boxes:
            position, turn = box.pose
            start = (eye - position) @ rotation_array(turn)
            steps = rays @ rotation_array(turn)
            half = np.array(box.shape.size_m) / 2
            one, two = (-half - start) / steps, (half - start) / steps
            enter = np.minimum(one, two).max(axis=-1)
            leave = np.maximum(one, two).min(axis=-1)
            hit = (enter <= leave) & (enter > 0)
            depth = np.where(hit, np.minimum(depth, enter), depth)
    return np.minimum(depth, FAR_M)
