"""Heightmaps and perspective depth images."""

import math

import numpy as np
import pybullet
import pytest

from ba_torchrl.sim.geometry import yaw_quaternion
from ba_torchrl.sim.shapes import Box, Decal
from ba_torchrl.sim.vision import depth
from ba_torchrl.sim.vision.depth import HeightCamera, PosedShape, SceneMesh, depth_image
from ba_torchrl.sim.vision.lens import Lens, oblique_lens, side_lenses
from ba_torchrl.sim.world import World
from tests.sim.vision.boxes import CENTER, placed, random_boxes, ray_depths, rays_of


def box_heights(boxes, center, side, pixels):
    """Return for each pixel centre the top of the box that contains it, without the camera."""
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


def test_recesses_appear_only_where_the_floor_is_visible():
    with World() as world:
        box = world.add(Box(size_m=(0.05, 0.05, 0.05)), "box")
        goal = world.add(Decal(size_m=(0.09, 0.09, 1e-3), recess_depth_m=0.02), "goal")
        box.place((0.02, 0.0, 0.025))
        goal.place((0.0, 0.0, 0.0))
        image = HeightCamera([box, goal]).heightmap((0.0, 0.0), 0.2, 100)
    assert image[[60, 30, 10], 50].tolist() == pytest.approx([0.05, -0.02, 0.0])


def test_a_rotated_camera_equals_a_world_rotated_the_other_way():
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


def test_hidden_bodies_are_left_out_until_they_are_shown_again():
    with World() as world:
        boxes = [world.add(Box(size_m=(0.05, 0.05, 0.05)), str(n)) for n in range(3)]
        goal = world.add(Decal(size_m=(0.05, 0.05, 1e-3), recess_depth_m=0.02), "goal")
        for n, body in enumerate((*boxes, goal)):
            body.place((0.1 * n, 0.0, 0.025))
        camera = HeightCamera(world.bodies)

        def shown(heights=(0.05, 0.05, 0.05, -0.02)):
            image = camera.heightmap((0.15, 0.0), 0.4, 80)
            values = image[[10, 30, 50, 70], 40]
            assert set(values.round(9)) <= {0.0, *heights}
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


@pytest.mark.parametrize(
    "lens",
    [
        oblique_lens(CENTER),
        side_lenses(CENTER, 0.5)[0],
        Lens((0.45, 0.02, 0.32), (0.45, 0.02, 0.0), math.radians(70)),
        Lens((0.9, 0.3, 0.1), (0.45, 0.0, 0.1), math.radians(60)),
    ],
)
def test_perspective_depth_equals_rays_cast_at_boxes(lens):
    rng = np.random.default_rng(1)
    boxes = random_boxes(rng, 5)
    image = depth_image([SceneMesh(boxes[:2]), SceneMesh(boxes[2:])], lens, 80)
    expected = ray_depths(boxes, lens, 80)
    assert (expected < ray_depths([], lens, 80)).sum() > 100
    np.testing.assert_allclose(image, expected, atol=1e-9)


def test_bodies_that_extend_behind_the_camera_are_clipped():
    lens = Lens((0.45, 0.0, 0.3), (0.45, 0.0, 0.0), math.radians(100))
    boxes = [
        placed((0.1, 0.3, 0.4), (0.7, 0.0, 0.3)),
        placed((0.05, 0.05, 0.1), (0.45, 0.0, 0.5)),  # entirely behind the camera
        placed((0.2, 0.1, 0.3), (0.3, 0.3, 0.35), yaw_quaternion(0.4)),
    ]
    image = depth_image([SceneMesh(boxes)], lens, 64)
    expected = ray_depths(boxes, lens, 64)
    assert (expected < 0.299).sum() > 100
    np.testing.assert_allclose(image, expected, atol=1e-9)


def test_a_recess_shows_a_lower_floor():
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


VIEW = ((0.02, -0.01), 0.4, 64, 0.0)


@pytest.fixture
def scene():
    """Yield a static slab, a block and a recess, and a camera that has rendered them."""
    with World() as world:
        slab = world.add(Box(size_m=(0.2, 0.1, 0.02), mass_kg=0.0), "slab")
        block = world.add(Box(size_m=(0.05, 0.05, 0.05)), "block")
        goal = world.add(Decal(size_m=(0.09, 0.09, 1e-3), recess_depth_m=0.02), "goal")
        slab.place((0.05, 0.0, 0.01), 0.4)
        block.place((0.02, 0.03, 0.045), 0.7)
        goal.place((-0.1, 0.0, 0.0), 0.2)
        camera = HeightCamera(world.bodies)
        for _ in range(2):
            camera.heightmap(*VIEW)
        yield {"slab": slab, "block": block, "goal": goal}, camera


@pytest.mark.parametrize("yaw", [0.0, 0.6])
@pytest.mark.parametrize("name", ["slab", "block", "goal"])
def test_a_camera_shows_each_change_of_a_body(scene, name, yaw):
    bodies, camera = scene
    body, view = bodies[name], (*VIEW[:3], yaw)
    images = [camera.heightmap(*view) for _ in range(2)]
    for change in ("move", "hide", "show"):
        if change == "move":
            body.place((-0.05, -0.08, body.position[2]), 1.1)
        else:
            body.is_hidden = change == "hide"
        images.append(camera.heightmap(*view))
        assert np.array_equal(images[-1], HeightCamera(bodies.values()).heightmap(*view))
        assert not np.array_equal(images[-1], images[-2])


def test_a_camera_shows_each_change_of_the_view(scene):
    bodies, camera = scene
    changes = [((0.0, 0.0), *VIEW[1:]), (VIEW[0], 0.3, *VIEW[2:]), (*VIEW[:2], 80, 0.0)]
    for number, view in enumerate((VIEW, *changes, (*VIEW[:3], 0.3), VIEW)):
        bodies["block"].place((0.01 * number, 0.0, 0.025))
        fresh = HeightCamera(bodies.values()).heightmap(*view)
        for _ in range(3):
            assert np.array_equal(camera.heightmap(*view), fresh)


def test_an_image_belongs_to_the_caller(scene):
    _, camera = scene
    before = camera.heightmap(*VIEW)
    camera.heightmap(*VIEW)[:] = 1.0
    assert np.array_equal(camera.heightmap(*VIEW), before)


def test_a_camera_draws_only_what_has_changed(scene, monkeypatch):
    bodies, camera = scene
    counts = []
    rasterize = depth.rasterize_heights
    monkeypatch.setattr(
        depth,
        "rasterize_heights",
        lambda vertices, faces, *rest: (
            counts.append(len(faces)),
            rasterize(vertices, faces, *rest),
        ),
    )
    camera.heightmap(*VIEW)
    assert counts == []
    bodies["block"].place((0.0, 0.0, 0.025))
    camera.heightmap(*VIEW)
    assert counts == [12]
    bodies["slab"].place((0.0, 0.0, 0.01))
    camera.heightmap(*VIEW)
    assert counts == [12, 12, 12]  # the block is drawn over the slab again
