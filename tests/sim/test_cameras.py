import math

import numpy as np
import pytest

import ba_torchrl
from ba_torchrl.sim.bodies import Box, Decal
from ba_torchrl.sim.cameras import HeightCamera, paint_square
from ba_torchrl.sim.world import World


def box_heights(boxes, center, side, pixels):
    """Independent arithmetic: for each pixel centre, the top of the box it lies in."""
    image = np.zeros((pixels, pixels))
    for i in range(pixels):
        for j in range(pixels):
            x = center[0] - side / 2 + (i + 0.5) * side / pixels
            y = center[1] - side / 2 + (j + 0.5) * side / pixels
            for (bx, by), yaw, size, top in boxes:
                u = math.cos(yaw) * (x - bx) + math.sin(yaw) * (y - by)
                v = -math.sin(yaw) * (x - bx) + math.cos(yaw) * (y - by)
                if abs(u) <= size[0] / 2 and abs(v) <= size[1] / 2:
                    image[i, j] = max(image[i, j], top)
    return image


def test_heightmap_equals_analytic_boxes():
    rng = np.random.default_rng(0)
    with World() as world:
        shapes = [(0.05, 0.05, 0.05), (0.12, 0.03, 0.02), (0.08, 0.08, 0.07)]
        bodies = [world.add(Box(size_m=s), f"{s}") for s in shapes]
        camera = HeightCamera(bodies)
        for _ in range(5):
            boxes = []
            for body, size in zip(bodies, shapes, strict=True):
                xy, yaw = rng.uniform(-0.15, 0.15, 2), rng.uniform(-3, 3)
                body.place((*xy, size[2] / 2 + 0.01), yaw)
                boxes.append((xy, yaw, size, size[2] + 0.01))
            center = rng.uniform(-0.05, 0.05, 2)
            image = camera.heightmap(tuple(center), 0.4, 64)
            np.testing.assert_allclose(image, box_heights(boxes, center, 0.4, 64), atol=1e-9)


def test_a_tilted_box_shows_its_slope():
    import pybullet

    with World() as world:
        box = world.add(Box(size_m=(0.1, 0.1, 0.1)), "box")
        turn = pybullet.getQuaternionFromEuler((0.0, math.pi / 4, 0.0))
        pybullet.resetBasePositionAndOrientation(
            box.id, (0, 0, 0.2), turn, physicsClientId=world.client
        )
        image = HeightCamera([box]).heightmap((0.0, 0.0), 0.2, 100)
        xs = (np.arange(100) + 0.5) * 0.002 - 0.1
        expected = np.clip(0.2 + 0.05 * math.sqrt(2) - np.abs(xs), 0, None)
        expected[np.abs(xs) > 0.05 * math.sqrt(2)] = 0
        np.testing.assert_allclose(image[:, 50], expected, atol=1e-9)


def test_decals_dip_only_where_the_floor_is_visible():
    with World() as world:
        box = world.add(Box(size_m=(0.05, 0.05, 0.05)), "box")
        goal = world.add(Decal(size_m=(0.09, 0.09, 1e-3), depth_m=0.02), "goal")
        box.place((0.02, 0.0, 0.025))
        goal.place((0.0, 0.0, 0.0))
        image = HeightCamera([box, goal]).heightmap((0.0, 0.0), 0.2, 100)
    assert image[60, 50] == pytest.approx(0.05)
    assert image[30, 50] == pytest.approx(-0.02)
    assert image[10, 50] == 0.0


def test_paint_square_turns_with_the_image():
    image = np.zeros((32, 32))
    paint_square(image, (16 + 6.0, 16 - 3.0), 4.0, 0.3, 1.0)
    turned = np.zeros((32, 32))
    # +90 degrees about z: (row, column) offsets (6, -3) become (3, 6)
    paint_square(turned, (16 + 3.0, 16 + 6.0), 4.0, 0.3 + math.pi / 2, 1.0)
    np.testing.assert_array_equal(np.rot90(image), turned)
    assert image.sum() == pytest.approx(64, abs=6)


def ground_and_block(env, z):
    """Depth of the floor and of a block's top with the tool at height z."""
    state = env.reset(seed=1)
    scene = env.scene
    x, y, _ = scene.task.block.position
    scene.motion.reset(((x, y, z), 0.0))
    depth = env._pixels(scene)[0]
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
    scene.motion.reset(((0.45, 0.0, 0.2), 0.0))
    scene.task.block.place((0.45 + 0.1, 0.0 - 0.05, 0.025), 0.0)
    depth = env._pixels(scene)[0]
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
    scene.motion.reset(((0.45, 0.0, 0.2), 0.0))
    scene.task.block.place((0.35, 0.12, 0.025))
    depth = env._pixels(scene)[0]
    rows, cols = np.nonzero(depth == 0)
    assert (cols.min(), cols.max()) == (size // 2 - half, size // 2 + half - 1)
    middle = rows[rows > size / 2]
    assert middle.mean() + 0.5 - size / 2 == pytest.approx(15 * size / 128, abs=0.5)
    assert set(rows) == {size - 1 - r for r in rows}
    scene.motion.reset(((0.45, 0.0, 0.2), math.pi / 2))
    np.testing.assert_array_equal(np.rot90(depth) == 0, env._pixels(scene)[0] == 0)
    env.close()


def test_turning_the_world_turns_the_image():
    env = ba_torchrl.make("close_loop/block_pushing", obs_size=64)
    env.reset(seed=3)
    scene = env.scene
    (cx, cy), task = env.workspace.center, scene.task
    scene.motion.reset(((cx, cy, 0.2), 0.4))
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
        scene.motion.reset(((cx, cy, 0.2), 0.4 + turn * math.pi / 2))
        images.append(env._pixels(scene)[0])
    np.testing.assert_allclose(np.rot90(images[0]), images[1], atol=1e-5)
    env.close()


def test_render_is_a_picture():
    env = ba_torchrl.make("close_loop/block_picking", obs_size=16)
    env.reset(seed=0)
    picture = env.render(width=64, height=48)
    assert picture.shape == (48, 64, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 10
    env.close()
