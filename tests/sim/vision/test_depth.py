import math

import numpy as np
import pytest

import ba_torchrl
from ba_torchrl.sim.geometry import yaw_quaternion
from ba_torchrl.sim.shapes import Box, Decal
from ba_torchrl.sim.vision.depth import (
    HeightCamera,
    PosedShape,
    SceneMesh,
    depth_image,
    paint_square,
    point_cloud,
    splat_heightmap,
    visible_points,
)
from ba_torchrl.sim.vision.lens import FAR_M, Lens, oblique_lens, side_lenses
from ba_torchrl.sim.vision.rgb import render_rgb, render_rgbd
from ba_torchrl.sim.world import World

WORKSPACE = ((0.3, 0.6), (-0.15, 0.15), (0.01, 0.25))
CENTER = (0.45, 0.0)


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
        goal = world.add(Decal(size_m=(0.09, 0.09, 1e-3), recess_depth_m=0.02), "goal")
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


def test_turning_the_world_turns_the_image():
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


def test_render_is_a_picture():
    env = ba_torchrl.make("close_loop/block_picking", obs_size=16)
    env.reset(seed=0)
    picture = env.render(width=64, height=48)
    assert picture.shape == (48, 64, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 10
    env.close()


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


def rotation(quaternion):
    x, y, z, w = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def rays_of(lens, pixels):
    """Independent arithmetic: the direction of each pixel with a unit step along the view."""
    forward = np.array(lens.target_m) - lens.eye_m
    forward /= np.linalg.norm(forward)
    columns = np.cross([1.0, 0.0, 0.0], forward)
    columns /= np.linalg.norm(columns)
    rows = np.cross(forward, columns)
    steps = ((np.arange(pixels) + 0.5) / pixels * 2 - 1) * math.tan(lens.fov_rad / 2)
    return forward + steps[:, None, None] * rows + steps[:, None] * columns


def ray_depths(boxes, lens, pixels):
    """Independent arithmetic: slabs of each box in its own frame, and the floor."""
    rays, eye = rays_of(lens, pixels), np.array(lens.eye_m)
    with np.errstate(divide="ignore"):
        depth = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        for box in boxes:
            position, turn = box.pose
            start = (eye - position) @ rotation(turn)
            steps = rays @ rotation(turn)
            half = np.array(box.shape.size_m) / 2
            one, two = (-half - start) / steps, (half - start) / steps
            enter = np.minimum(one, two).max(axis=-1)
            leave = np.maximum(one, two).min(axis=-1)
            hit = (enter <= leave) & (enter > 0)
            depth = np.where(hit, np.minimum(depth, enter), depth)
    return np.minimum(depth, FAR_M)


def distance_to_box(points, box):
    position, turn = box.pose
    inside = np.abs((points - np.array(position)) @ rotation(turn)) - np.array(box.shape.size_m) / 2
    outer = np.linalg.norm(np.maximum(inside, 0), axis=1)
    return np.abs(outer + np.minimum(inside.max(axis=1), 0))


# -- straight down ---------------------------------------------------------------------------


def test_a_turned_camera_sees_the_world_turned_the_other_way():
    yaw, (cx, cy) = 0.7, (0.42, 0.03)
    things = [((0.07, 0.03), 0.2), ((-0.06, 0.05), 1.1)]
    cos, sin = math.cos(yaw), math.sin(yaw)
    images = []
    for turned in (True, False):
        bodies = []
        for number, ((dx, dy), heading) in enumerate(things):
            if not turned:
                dx, dy = cos * dx + sin * dy, cos * dy - sin * dx
                heading = heading - yaw
            shape = (
                Box(size_m=(0.1, 0.04, 0.05))
                if number
                else Decal(size_m=(0.09, 0.09, 1e-3), recess_depth_m=0.02)
            )
            z = 0.025 if number else 0.0
            bodies.append(PosedShape(shape, ((cx + dx, cy + dy, z), yaw_quaternion(heading))))
        camera = HeightCamera(bodies)
        images.append(camera.heightmap((cx, cy), 0.3, 96, yaw if turned else 0.0))
    np.testing.assert_allclose(images[0], images[1], atol=1e-12)
    assert {-0.02, 0.0, 0.05} == set(images[0].round(9).ravel())


def test_a_turned_camera_equals_analytic_boxes():
    size, yaw = (0.12, 0.03, 0.02), 2.2
    box = placed(size, (0.02, 0.05, 0.01), yaw_quaternion(0.5))
    image = HeightCamera([box]).heightmap((0.0, 0.0), 0.2, 64, yaw)
    x = math.cos(yaw) * 0.02 + math.sin(yaw) * 0.05
    y = math.cos(yaw) * 0.05 - math.sin(yaw) * 0.02
    expected = box_heights([((x, y), 0.5 - yaw, size, 0.02)], (0.0, 0.0), 0.2, 64)
    np.testing.assert_allclose(image, expected, atol=1e-9)


def test_hidden_bodies_are_left_out_until_they_return():
    with World() as world:
        boxes = [world.add(Box(size_m=(0.05, 0.05, 0.05)), str(n)) for n in range(3)]
        goal = world.add(Decal(size_m=(0.05, 0.05, 1e-3), recess_depth_m=0.02), "goal")
        for n, body in enumerate((*boxes, goal)):
            body.place((0.1 * n, 0.0, 0.025))
        camera = HeightCamera(world.bodies)

        def shown(heights_and_dips=(0.05, 0.05, 0.05, -0.02)):
            image = camera.heightmap((0.15, 0.0), 0.4, 80)
            values = image[[10, 30, 50, 70], 40]
            assert set(values.round(9)) <= {0.0, *heights_and_dips}
            return [bool(value) for value in values]

        assert shown() == [True, True, True, True]
        boxes[1].is_hidden = goal.is_hidden = True
        assert shown() == [True, False, True, False]
        boxes[1].is_hidden, boxes[0].is_hidden = False, True
        assert shown() == [False, True, True, False]
        for body in world.bodies:
            body.is_hidden = True
        assert shown() == [False] * 4
        assert (depth_image([camera.mesh], oblique_lens(CENTER), 16) > 0).all()
        for body in world.bodies:
            body.is_hidden = False
        assert shown() == [True] * 4


# -- perspective -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "lens",
    [
        oblique_lens(CENTER),
        side_lenses(CENTER, 0.5)[0],
        Lens((0.45, 0.02, 0.32), (0.45, 0.02, 0.0), math.radians(70)),
        Lens((0.9, 0.3, 0.1), (0.45, 0.0, 0.1), math.radians(60)),
    ],
)
def test_perspective_equals_rays_that_meet_boxes(lens):
    rng = np.random.default_rng(1)
    for _ in range(3):
        boxes = random_boxes(rng, 5)
        image = depth_image([SceneMesh(boxes[:2]), SceneMesh(boxes[2:])], lens, 80)
        expected = ray_depths(boxes, lens, 80)
        assert (expected < ray_depths([], lens, 80)).sum() > 100
        np.testing.assert_allclose(image, expected, atol=1e-9)


def test_what_reaches_behind_the_camera_is_cut_off_there():
    lens = Lens((0.45, 0.0, 0.3), (0.45, 0.0, 0.0), math.radians(100))
    boxes = [
        placed((0.1, 0.3, 0.4), (0.7, 0.0, 0.3)),
        placed((0.05, 0.05, 0.1), (0.45, 0.0, 0.5)),  # all of it behind
        placed((0.2, 0.1, 0.3), (0.3, 0.3, 0.35), yaw_quaternion(0.4)),
    ]
    image = depth_image([SceneMesh(boxes)], lens, 64)
    expected = ray_depths(boxes, lens, 64)
    assert (expected < 0.299).sum() > 100
    np.testing.assert_allclose(image, expected, atol=1e-9)


def test_through_a_dip_one_looks_on_to_a_lower_floor():
    goal = PosedShape(
        Decal(size_m=(0.09, 0.09, 1e-3), recess_depth_m=0.02),
        ((0.5, 0.04, 0.0), yaw_quaternion(0.3)),
    )
    block = placed((0.05, 0.05, 0.05), (0.5, 0.09, 0.025))
    lens = oblique_lens(CENTER)
    image = depth_image([SceneMesh([goal, block])], lens, 80)
    rays = rays_of(lens, 80)
    floor = np.array(lens.eye_m) + rays * (-lens.eye_m[2] / rays[..., 2])[..., None]
    dx, dy = floor[..., 0] - 0.5, floor[..., 1] - 0.04
    u, v = math.cos(0.3) * dx + math.sin(0.3) * dy, math.cos(0.3) * dy - math.sin(0.3) * dx
    lowered = (np.abs(u) < 0.045) & (np.abs(v) < 0.045)
    plain = ray_depths([block], lens, 80)
    seen = lowered & (plain == ray_depths([], lens, 80))
    assert 100 < seen.sum() < lowered.sum()
    np.testing.assert_allclose(image[~seen], plain[~seen], atol=1e-9)
    np.testing.assert_allclose(image[seen], 0.62 / -rays[seen][:, 2], atol=1e-9)


def test_a_lens_tells_heights_and_the_reach_of_planes():
    lens = oblique_lens(CENTER)
    box = placed((0.2, 0.2, 0.06), (0.45, 0.0, 0.03))
    depth = depth_image([SceneMesh([box])], lens, 100)
    heights = lens.heights_m(depth)
    assert heights[50, 50] == pytest.approx(0.06, abs=1e-9)
    np.testing.assert_allclose(heights[:5], 0.0, atol=1e-9)
    floor = ray_depths([], lens, 1000)
    low, high = lens.plane_depth_range_m(0.0)
    assert low == pytest.approx(floor.min(), rel=2e-3)
    assert high == pytest.approx(floor.max(), rel=2e-3)
    upward = Lens((0.0, 0.0, 0.3), (1.0, 0.0, 0.3), 1.0)
    assert upward.plane_depth_range_m(0.0)[1] == FAR_M


@pytest.mark.parametrize("width", [0.3, 0.45, 0.75, 1.2])
def test_side_cameras_show_all_of_the_square(width):
    for lens in side_lenses(CENTER, width):
        for dx in (-width / 2, width / 2):
            for dy in (-width / 2, width / 2):
                offset = np.array([CENTER[0] + dx, CENTER[1] + dy, 0.0]) - lens.eye_m
                rows, columns, depth = lens.axes @ offset
                assert max(abs(rows), abs(columns)) / depth < math.tan(lens.fov_rad / 2)


# -- points ----------------------------------------------------------------------------------


def test_points_of_a_cloud_lie_on_the_surfaces_inside_the_bounds():
    boxes = random_boxes(np.random.default_rng(2), 4, span=0.1)
    lenses = side_lenses(CENTER, 0.3)
    cloud = point_cloud([SceneMesh(boxes)], lenses, 3000, WORKSPACE)
    assert cloud.shape == (3000, 3)
    assert cloud.dtype == np.float32
    distances = np.stack([distance_to_box(cloud, box) for box in boxes] + [np.abs(cloud[:, 2])])
    assert distances.min(axis=0).max() < 1e-6
    assert ((distances < 1e-6).sum(axis=1) > 20).all()  # every box, and the floor
    low, high = np.array(WORKSPACE).T
    assert (cloud[:, :2] >= low[:2] - 1e-6).all()
    assert (cloud <= high + 1e-6).all()


def test_a_cloud_follows_from_the_scene_and_the_generator_alone():
    surfaces = [SceneMesh(random_boxes(np.random.default_rng(3), 3))]
    lenses = side_lenses(CENTER, 0.3)
    clouds = [
        point_cloud(surfaces, lenses, 500, WORKSPACE, rng)
        for rng in (None, None, *(np.random.default_rng(seed) for seed in (1, 1, 2)))
    ]
    np.testing.assert_array_equal(clouds[0], clouds[1])
    np.testing.assert_array_equal(clouds[2], clouds[3])
    assert not np.array_equal(clouds[2], clouds[4])
    assert len(np.unique(clouds[2], axis=0)) == 500


def test_a_cloud_of_more_points_than_are_seen_repeats_all_of_them():
    narrow = ((0.44, 0.46), (-0.01, 0.01), (0.0, 0.2))
    lenses = side_lenses(CENTER, 0.3)
    seen = visible_points([SceneMesh([])], lenses, 200, (*narrow[:2], (-1.0, 1.0)))
    cloud = point_cloud([SceneMesh([])], lenses, 20_000, narrow)
    assert 0 < len(seen) < 5000
    unique, counts = np.unique(cloud, axis=0, return_counts=True)
    assert len(cloud) == 20_000
    assert len(unique) == len(seen)
    assert counts.max() - counts.min() <= 1


def test_a_cloud_of_nothing_is_an_error():
    with pytest.raises(ValueError, match="see nothing"):
        point_cloud([SceneMesh([])], side_lenses(CENTER, 0.3), 10, ((5, 6), (5, 6), (0, 1)))


def test_points_of_the_floor_sink_where_a_decal_dips():
    goal = PosedShape(
        Decal(size_m=(0.09, 0.09, 1e-3), recess_depth_m=0.02), ((0.5, 0.04, 0), (0, 0, 0, 1))
    )
    points = visible_points(
        [SceneMesh([goal])], side_lenses(CENTER, 0.3), 100, (*WORKSPACE[:2], (-1.0, 1.0))
    )
    inside = (np.abs(points[:, 0] - 0.5) < 0.045) & (np.abs(points[:, 1] - 0.04) < 0.045)
    assert 100 < inside.sum() < len(points)
    np.testing.assert_allclose(points[:, 2], np.where(inside, -0.02, 0.0), atol=1e-12)


def test_gaps_between_points_take_the_nearest_pixels_height():
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(0, 1, (40, 2)), rng.uniform(0, 0.1, 40)])
    image = splat_heightmap(points, (0.5, 0.5), 1.0, 24)
    filled = {}
    for x, y, z in points:
        key = (math.floor(x * 24), math.floor(y * 24))
        filled[key] = max(filled.get(key, -1.0), z)
    for i in range(24):
        for j in range(24):
            distance = {key: (key[0] - i) ** 2 + (key[1] - j) ** 2 for key in filled}
            nearest = min(distance.values())
            assert image[i, j] in [filled[key] for key in filled if distance[key] == nearest]
    assert not splat_heightmap(points[:0], (0.5, 0.5), 1.0, 8).any()


# -- colour ----------------------------------------------------------------------------------


def test_the_depth_of_colour_pictures_is_that_of_the_depth_camera():
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
    assert off.max() < 0.05  # at an edge, the surface behind
    red, _, blue = np.moveaxis(rgb.astype(int), -1, 0)
    assert (red > blue + 30)[owner].mean() > 0.97
    assert not (red > blue + 30)[~owner].mean() > 0.01


def test_pictures_have_a_light_floor_with_shadows_under_things():
    with World() as world:
        box = world.add(Box(size_m=(0.1, 0.1, 0.1), color=(0.8, 0.1, 0.1, 1.0)), "box")
        pictures = []
        for z in (0.3, -5.0):  # in the air, and out of sight
            box.place((0.0, 0.0, z))
            pictures.append(render_rgb(world, (0.0, 0.0, 0.1), 120, 90).astype(int))
        colored = render_rgb(world, (0.0, 0.0, 0.1), 120, 90, floor_rgb=(0.2, 0.4, 0.2))
    with_box, empty = pictures
    assert (empty == empty[0, 0]).all()
    assert empty.min() > 225
    assert tuple(colored[45, 60]) == (51, 102, 51)
    gray = np.ptp(with_box, axis=-1) < 10
    shadow = gray & (with_box.sum(-1) < empty.sum(-1) - 60)
    assert 50 < shadow.sum() < 2000
    rows, _ = np.nonzero(shadow)
    assert rows.mean() > 45  # on the floor below the box
    assert not shadow[:5].any()
