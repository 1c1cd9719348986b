"""Colour images: their depth, floor and shadows."""

import numpy as np

from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.depth import SceneMesh, depth_image
from ba_torchrl.sim.vision.lens import oblique_lens
from ba_torchrl.sim.vision.rgb import Viewpoint, render_rgb, render_rgbd
from ba_torchrl.sim.world import World
from tests.sim.vision.boxes import CENTER, ray_depths

VIEWPOINT = Viewpoint((0.0, 0.0, 0.1), 1.05, yaw_deg=62.0, pitch_deg=-27.0)


def test_rgbd_depth_equals_the_depth_camera():
    with World() as world:
        boxes = [
            world.add(Box(size_m=(0.05, 0.05, 0.05), color=color), "box")
            for color in ((0.8, 0.1, 0.1, 1.0), (0.1, 0.1, 0.8, 1.0))
        ]
        boxes[0].place((0.42, 0.05, 0.025), 0.3)
        boxes[1].place((0.5, -0.06, 0.025), 0.9)
        lens = oblique_lens(CENTER)
        rgb, depth = render_rgbd(world, lens, 96)
        expected = depth_image([SceneMesh(boxes)], lens, 96)
        owner = depth_image([SceneMesh(boxes[:1])], lens, 96) < ray_depths([], lens, 96) - 1e-6
    assert rgb.shape == (96, 96, 3)
    assert rgb.dtype == np.uint8
    off = np.abs(depth - expected)
    assert np.quantile(off, 0.995) < 1e-4
    assert off.max() < 0.05  # at an edge, the depth of the surface behind it
    red, _, blue = np.moveaxis(rgb.astype(int), -1, 0)
    assert (red > blue + 30)[owner].mean() > 0.97
    assert not (red > blue + 30)[~owner].mean() > 0.01


def test_rgb_images_have_a_light_floor_with_shadows_under_bodies():
    with World() as world:
        box = world.add(Box(size_m=(0.1, 0.1, 0.1), color=(0.8, 0.1, 0.1, 1.0)), "box")
        images = []
        for z in (0.3, -5.0):  # in the air, and out of view
            box.place((0.0, 0.0, z))
            images.append(render_rgb(world, VIEWPOINT, 120, 90).astype(int))
        colored = render_rgb(world, VIEWPOINT, 120, 90, floor_rgb=(0.2, 0.4, 0.2))
    with_box, empty = images
    assert (empty == empty[0, 0]).all()
    assert empty.min() > 225
    assert tuple(colored[45, 60]) == (51, 102, 51)
    gray = np.ptp(with_box, axis=-1) < 10
    shadow = gray & (with_box.sum(-1) < empty.sum(-1) - 60)
    assert 50 < shadow.sum() < 2000
    rows, _ = np.nonzero(shadow)
    assert rows.mean() > 45  # on the floor below the box
    assert not shadow[:5].any()
