import dataclasses
import math

import numpy as np
import pytest

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.sim.geometry import yaw_quaternion
from ba_torchrl.sim.shapes import Box, Decal
from ba_torchrl.sim.vision.camera_views import (
    FINGER_SQUARE_HALF_M,
    MAX_RECESS_M,
    VIEWS,
    ViewInput,
    ViewSetup,
)
from ba_torchrl.sim.vision.depth import HeightCamera, PosedShape
from ba_torchrl.sim.vision.lens import oblique_lens
from ba_torchrl.sim.world import World

SETUP = ViewSetup(
    center_m=(0.45, 0.0),
    z_m=(0.01, 0.25),
    workspace_m=0.3,
    width_m=0.45,
    pixels=128,
    camera_height_m=0.12,
    finger_span_m=0.105,
)
TOP_DOWN = [f"camera_center_{axes}" for axes in ("xyz", "xyzr", "xyr", "xy", "z")] + ["camera_fix"]
IN_COLOR = "camera_side_rgbd"
TOOL = ((0.40, 0.05, 0.15), 0.5)


@pytest.fixture(scope="module")
def world():
    """Return a world with a block, for colour images."""
    with World() as world:
        world.add(Box(size_m=(0.05, 0.05, 0.05)), "block").place((0.45, -0.05, 0.025), 0.4)
        yield world


def block(x=0.45, y=-0.05, yaw=0.4, size=(0.05, 0.05, 0.05)):
    return PosedShape(Box(size_m=size), ((x, y, size[2] / 2), yaw_quaternion(yaw)))


def goal(x=0.52, y=0.03, yaw=0.2):
    shape = Decal(size_m=(0.09, 0.09, 1e-3), recess_depth_m=0.02)
    return PosedShape(shape, ((x, y, 0.0), yaw_quaternion(yaw)))


def view_input(world, bodies, tool=TOOL, opening=1.0, **setup):
    setup = dataclasses.replace(SETUP, **setup)
    return ViewInput(setup, world, HeightCamera(bodies), tool, opening)


def image(name, *args, **options):
    return VIEWS[name].image(view_input(*args, **options))[-1]


@pytest.mark.parametrize("task", ["block_picking", "block_pushing"])
def test_environments_observe_the_default_view(task):
    env = ba_torchrl.make(f"close_loop/{task}", seed=2)
    state = env.reset()
    scene, workspace = env.scene, env.workspace
    setup = ViewSetup(
        center_m=workspace.center,
        z_m=workspace.z,
        workspace_m=workspace.width,
        width_m=env.config.view_scale * workspace.width,
        pixels=env.config.obs_size,
        camera_height_m=scene.robot.camera_height_m,
        finger_span_m=scene.robot.finger_span_m,
    )
    robot = scene.robot
    ours = VIEWS[env.config.view_type].image(
        ViewInput(setup, scene.world, scene.camera, robot.tool_pose(), robot.opening())
    )
    np.testing.assert_array_equal(ours.astype(np.float32), state[keys.DEPTH].numpy())
    env.close()


@pytest.mark.parametrize("name", sorted(VIEWS))
def test_values_are_within_range_m(name, world):
    rng = np.random.default_rng(1)
    view = VIEWS[name]
    low, high = view.range_m(SETUP)
    assert -0.5 < low < high < 1.5
    for _ in range(2):
        bodies = [
            goal(),
            block(*rng.uniform((0.3, -0.15), (0.6, 0.15)), size=(0.04, 0.05, rng.uniform(0, 0.4))),
        ]
        tool = (tuple(rng.uniform((0.3, -0.15, 0.0), (0.6, 0.15, 0.26))), rng.uniform(-3, 3))
        scene = view_input(world, bodies, tool, rng.uniform(), pixels=48)
        values = view.image(scene)
        assert values.shape == (view.channels, 48, 48)
        assert values.dtype == np.float64
        assert np.isfinite(values).all()
        assert values.min() >= low
        assert values.max() <= high
        again = view.image(scene)
        np.testing.assert_array_equal(values, again)
        assert not np.shares_memory(values, again)


@pytest.mark.parametrize("name", sorted(set(VIEWS) - {IN_COLOR}))
def test_blocks_goals_and_fingers_are_visible(name, world):
    def changed(one, other):
        return (np.abs(one - other) > 1e-3).sum()

    everything = image(name, world, [goal(), block()])
    assert changed(everything, image(name, world, [block()])) > 100
    assert changed(everything, image(name, world, [goal()])) > 50
    assert changed(everything, image(name, world, [goal(), block()], opening=0.3)) > 20
    hidden = dataclasses.replace(block(), is_hidden=True)
    assert not changed(image(name, world, [goal(), hidden]), image(name, world, [goal()]))


@pytest.mark.parametrize("name", TOP_DOWN)
def test_heights_and_depths_are_consistent(name, world):
    depth = image(name, world, [block(), goal()], opening=0.0)
    heights = image(f"{name}_height", world, [block(), goal()], opening=0.0)
    origin = 0.15 + (0.12 if "z" in name.removeprefix("camera_center_") else 0.0)
    fingers = depth == 0
    np.testing.assert_allclose(depth[~fingers], origin - heights[~fingers], atol=1e-12)
    assert (heights[fingers] == 0.15).all()
    assert {-0.02, 0.0, 0.05} <= set(heights.round(9).ravel())


@pytest.mark.parametrize("name", sorted(set(VIEWS) - {IN_COLOR, "render_center_height"}))
def test_a_quarter_turn_of_the_scene(name, world):
    """It rotates the image where the view says so, and nowhere else."""

    def seen(turns):
        """Return the image of block and tool after quarter turns about the workspace's centre."""

        def turned(x, y):
            for _ in range(turns):
                x, y = SETUP.center_m[0] - y, x - SETUP.center_m[0]
            return x, y

        angle = turns * math.pi / 2
        bodies = [block(*turned(0.47, -0.03), 0.4 + angle, size=(0.05, 0.08, 0.05))]
        return image(name, world, bodies, ((*turned(0.41, 0.05), 0.15), 0.5 + angle))

    before, after = seen(0), seen(1)
    differs = np.abs(after - np.rot90(before)).mean() > 2e-3
    assert differs != VIEWS[name].rotates_with_scene
    if "r" in name.removesuffix("_height").rpartition("_")[2] and name.startswith("camera_center"):
        np.testing.assert_allclose(after, before, atol=1e-9)


@pytest.mark.parametrize("name", [*TOP_DOWN, "render_center"])
@pytest.mark.parametrize("opening", [0.0, 0.4])
def test_position_and_size_of_finger_squares(name, opening, world):
    (x, y, _), yaw = TOOL
    values = image(name, world, [], opening=opening)
    centered = "center_z" not in name and name != "camera_fix"
    center = (x, y) if centered else SETUP.center_m
    turn = yaw if name.endswith("r") and centered and "xy" in name else 0.0
    rows, cols = np.nonzero(values == 0)
    u = (rows + 0.5) * 0.45 / 128 - 0.225
    v = (cols + 0.5) * 0.45 / 128 - 0.225
    points = np.stack(
        [
            center[0] + math.cos(turn) * u - math.sin(turn) * v,
            center[1] + math.sin(turn) * u + math.cos(turn) * v,
        ],
        axis=1,
    )
    along = (points - [x, y]) @ [math.cos(yaw), math.sin(yaw)]
    across = (points - [x, y]) @ [-math.sin(yaw), math.cos(yaw)]
    offset = max(0.105 * opening / 2, FINGER_SQUARE_HALF_M)  # closed fingers touch
    assert np.abs(np.abs(along) - offset).max() <= FINGER_SQUARE_HALF_M + 1e-6
    assert np.abs(across).max() <= FINGER_SQUARE_HALF_M + 1e-6
    assert along[along > 0].mean() == pytest.approx(offset, abs=2e-3)
    assert along[along < 0].mean() == pytest.approx(-offset, abs=2e-3)
    assert len(rows) == pytest.approx(2 * (2 * FINGER_SQUARE_HALF_M * 128 / 0.45) ** 2, rel=0.2)


def test_surfaces_above_the_camera_are_clipped(world):
    tower = [block(0.45, -0.05, 0.0, (0.05, 0.05, 0.5))]
    tops = {
        name: image(f"{name}_height", world, tower, opening=0.0).max()
        for name in ("camera_center_xyz", "camera_center_xy", "render_center")
    }
    assert tops["camera_center_xyz"] == pytest.approx(0.15 + 0.12)
    assert tops["camera_center_xy"] == pytest.approx(0.25 + 0.04)
    assert image("camera_center_xyz", world, tower).min() == 0.0
    # only points below the fingers, and the fingers themselves
    assert 0.13 < image("render_center_height", world, tower, (TOOL[0], 0.0))[:, :40].max() <= 0.14


@pytest.mark.parametrize("z", [0.03, 0.2])
def test_render_center_agrees_with_the_orthographic_view(z, world):
    bodies = [goal(0.55, 0.1), block(0.40, 0.0), block(0.47, -0.06, 1.0)]
    tool = ((0.45, 0.02, z), 0.3)
    splatted = image("render_center_height", world, bodies, tool)
    above = image("camera_center_xy_height", world, bodies, tool)
    steps = np.zeros_like(above, dtype=bool)
    for di in range(-2, 3):
        for dj in range(-2, 3):
            steps |= np.abs(np.roll(above, (di, dj), (0, 1)) - above) > 1e-3
    np.testing.assert_allclose(splatted[~steps], above[~steps], atol=1e-9)
    for height in (-0.02, 0.05):
        assert (splatted[~steps].round(9) == height).sum() > 50
    assert (np.abs(splatted - above) > 5e-3).sum() < 0.2 * (above != 0).sum()


def test_geometry_of_the_perspective_view(world):
    bodies = [block(0.45, -0.05, 0.0)]
    tool = ((0.45, -0.05, 0.1), 0.0)
    values = image("pers_center_xyz", world, bodies, tool)
    assert values[64, 64] == pytest.approx(0.22 - 0.05)
    assert values[0, 0] == pytest.approx(0.22)
    # an edge of 5 cm at a depth of 17 cm with a field of view of 70 degrees
    edge = 0.025 / 0.17 / math.tan(math.radians(35)) * 64
    cols = np.nonzero(np.isclose(values[64], 0.17))[0]
    assert (cols.min(), cols.max()) == (math.ceil(64 - edge - 0.5), math.floor(64 + edge - 0.5))
    # the tips of the fingers are 12 cm below the camera
    rows, cols = np.nonzero(values == 0)
    scale = 64 / math.tan(math.radians(35)) / 0.12
    assert rows[rows > 64].mean() + 0.5 - 64 == pytest.approx(0.105 / 2 * scale, abs=0.6)
    assert np.ptp(cols) + 1 == pytest.approx(2 * FINGER_SQUARE_HALF_M * scale, abs=1)


def test_geometry_of_the_side_view(world):
    lens = oblique_lens(SETUP.center_m)
    assert lens.eye_m == (1.0, 0.0, 0.6)

    def pixel(x, y, z):
        rows, cols, depth = lens.axes @ (np.array([x, y, z]) - lens.eye_m)
        scale = 64 / math.tan(math.radians(20)) / depth
        return math.floor(64 + rows * scale), math.floor(64 + cols * scale), depth

    values = image("camera_side", world, [block(0.55, -0.08, 0.0)])
    heights = image("camera_side_height", world, [block(0.55, -0.08, 0.0)])
    i, j, depth = pixel(0.55, -0.08, 0.05)
    assert i > 64 > j  # nearer to the camera is lower, smaller y to the left
    assert values[i, j] == pytest.approx(depth, abs=4e-3)
    assert heights[i, j] == pytest.approx(0.05, abs=1e-9)
    # both fingers: the depth of their front faces
    (x, y, z), yaw = TOOL
    for side in (-0.0525, 0.0525):
        i, j, depth = pixel(x + side * math.cos(yaw), y + side * math.sin(yaw), z + 0.03)
        assert depth - 0.03 < values[i, j] < depth - 0.005
        assert heights[i, j] == pytest.approx(z + 0.03, abs=0.02)


def test_rgbd_side_view_agrees_with_the_depth_view(world):
    values = VIEWS[IN_COLOR].image(view_input(world, world.bodies))
    assert values.shape == (4, 128, 128)
    depth = image("camera_side", world, world.bodies, ((0.45, 0.0, 0.25), 0.0))
    heights = image("camera_side_height", world, world.bodies, ((0.45, 0.0, 0.25), 0.0))
    low = heights < 0.2  # without the fingers: the world contains no robot
    assert np.quantile(np.abs(values[3] - depth)[low], 0.99) < 1e-4
    on_block = (heights > 0.01) & low
    assert values[0][on_block].mean() > 2 * values[2][on_block].mean()


def test_image_width_follows_the_setup(world):
    tile = [block(0.45, 0.0, 0.0, size=(0.2, 0.2, 0.05))]
    for width in (0.45, 0.9):
        heights = image("camera_fix_height", world, tile, width_m=width, opening=0.0)
        assert (heights == 0.05).sum() == pytest.approx((0.2 * 128 / width) ** 2, rel=0.1)
    assert VIEWS["camera_center_xyz"].range_m(
        dataclasses.replace(SETUP, z_m=(0.0, 0.4), camera_height_m=0.06)
    ) == (0.0, 0.4 + 0.06 + MAX_RECESS_M)
