"""The close-loop depth image by default: scale and extent."""

import numpy as np
import pytest


def ground_and_block(env, z):
    """Return the depth of the floor and of a block's top with the tool at height z."""
    state = env.reset(seed=1)
    scene = env.scene
    x, y, _ = scene.task.block.position
    scene.controller.reset(((x, y, z), 0.0))
    depth = env._images(scene)["depth"][0]
    center = env.config.obs_size // 2
    assert state["depth"].shape == (1, env.config.obs_size, env.config.obs_size)
    return depth.max(), depth[center, center]


def test_a_five_centimetre_block_reads_five_centimetres_at_any_camera_height(make):
    env = make("close_loop/block_picking")
    for z in (0.08, 0.12, 0.2, 0.25):
        ground, top = ground_and_block(env, z)
        assert ground == pytest.approx(z + 0.12, abs=1e-5)
        assert ground - top == pytest.approx(0.05, abs=1e-4)


def test_the_image_covers_45_centimetres_around_the_tool(make):
    env = make("close_loop/block_picking", obs_size=90)
    env.reset(seed=0)
    scene = env.scene
    scene.controller.reset(((0.45, 0.0, 0.2), 0.0))
    scene.task.block.place((0.45 + 0.1, 0.0 - 0.05, 0.025), 0.0)
    depth = env._images(scene)["depth"][0]
    rows, cols = np.nonzero(np.isclose(depth, 0.32 - 0.05, atol=1e-6))
    # 5 mm per pixel; +x is down the rows, +y along the columns
    assert (rows.min(), rows.max()) == (45 + 15, 45 + 24)
    assert (cols.min(), cols.max()) == (45 - 15, 45 - 6)
