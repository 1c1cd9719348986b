"""The close-loop depth image: scale, extent, fingers, rotation; and the rendered image."""

import math

import numpy as np
import pytest

import ba_torchrl


def ground_and_block(env, z):
    """Return the depth of the floor and of a block's top with the tool at height z."""
    state = env.reset(seed=1)
    scene = env.scene
    x, y, _ = scene.task.block.position
    scene.controller.reset(((x, y, z), 0.0))
    depth = env._images(scene)["pixels"][0]
    center = env.config.obs_size // 2
    assert state["pixels"].shape == (1, env.config.obs_size, env.config.obs_size)
    return depth.max(), depth[center, center]


def test_a_five_centimetre_block_reads_five_centimetres_at_any_camera_height():
    env = ba_torchrl.make("close_loop/block_picking")
    for z in (0.08, 0.12, 0.2, 0.25):
        ground, top = ground_and_block(env, z)
        assert ground == pytest.approx(z + 0.12, abs=1e-5)
        assert ground - top == pytest.approx(0.05, abs=1e-4)
    env.close()


def test_the_image_covers_45_centimetres_around_the_tool():
    env = ba_torchrl.make("close_loop/block_picking", obs_size=90)
    env.reset(seed=0)
    scene = env.scene
    scene.controller.reset(((0.45, 0.0, 0.2), 0.0))
    scene.task.block.place((0.45 + 0.1, 0.0 - 0.05, 0.025), 0.0)
    depth = env._images(scene)["pixels"][0]
    rows, cols = np.nonzero(np.isclose(depth, 0.32 - 0.05, atol=1e-6))
    # 5 mm per pixel; +x is down the rows, +y along the columns
    assert (rows.min(), rows.max()) == (45 + 15, 45 + 24)
    assert (cols.min(), cols.max()) == (45 - 15, 45 - 6)
    env.close()


@pytest.mark.parametrize(("size", "half"), [(128, 3), (64, 2)])
def test_fingers_are_squares_of_zero_that_open_along_x(size, half):
    env = ba_torchrl.make("close_loop/block_picking", obs_size=size)
    env.reset(seed=0)
    scene = env.scene
    scene.controller.reset(((0.45, 0.0, 0.2), 0.0))
    scene.task.block.place((0.35, 0.12, 0.025))
    depth = env._images(scene)["pixels"][0]
    rows, cols = np.nonzero(depth == 0)
    assert (cols.min(), cols.max()) == (size // 2 - half, size // 2 + half - 1)
    middle = rows[rows > size / 2]
    assert middle.mean() + 0.5 - size / 2 == pytest.approx(15 * size / 128, abs=0.5)
    assert set(rows) == {size - 1 - r for r in rows}
    scene.controller.reset(((0.45, 0.0, 0.2), math.pi / 2))
    np.testing.assert_array_equal(np.rot90(depth) == 0, env._images(scene)["pixels"][0] == 0)
    env.close()


def test_rotating_the_world_rotates_the_image():
    env = ba_torchrl.make("close_loop/block_pushing", obs_size=64)
    env.reset(seed=3)
    scene = env.scene
    (cx, cy), task = env.workspace.center, scene.task
    scene.controller.reset(((cx, cy, 0.2), 0.4))
    images = []
    for turn in range(2):
        for body, (dx, dy), yaw in (
            (task.block, (0.06, 0.02), 0.3),
            (task.goal, (-0.05, 0.04), 0.1),
        ):
            if turn:
                dx, dy = -dy, dx
            z = body.position[2]
            body.place((cx + dx, cy + dy, z), yaw + turn * math.pi / 2)
        scene.controller.reset(((cx, cy, 0.2), 0.4 + turn * math.pi / 2))
        images.append(env._images(scene)["pixels"][0])
    np.testing.assert_allclose(np.rot90(images[0]), images[1], atol=1e-5)
    env.close()


def test_render_returns_an_rgb_image():
    env = ba_torchrl.make("close_loop/block_picking", obs_size=16)
    env.reset(seed=0)
    image = env.render(width=64, height=48)
    assert image.shape == (48, 64, 3)
    assert image.dtype == np.uint8
    assert image.std() > 10
    env.close()
