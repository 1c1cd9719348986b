"""Ramps and bumps: the surface that tasks assume is the one that PyBullet collides with."""

import math

import numpy as np
import pybullet
import pytest
from scipy.optimize import linprog

import ba_torchrl
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.bodies import world_vertices
from ba_torchrl.sim.geometry import quaternion_matrix, tool_rotation
from ba_torchrl.sim.robots.kuka import Kuka
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.world import World
from ba_torchrl.tasks.manipulation.footprints import Rectangle, gap_m, outline
from ba_torchrl.tasks.open_loop.houses import HouseBuilding2
from ba_torchrl.tasks.six_dof import VARIANTS, task_on
from ba_torchrl.tasks.terrain.bumps import Bumps
from ba_torchrl.tasks.terrain.flat import Flat
from ba_torchrl.tasks.terrain.ramps import EDGE_MARGIN_M, GAP_M, RampLayout, Ramps
from ba_torchrl.tasks.terrain.sloped import lowest_plane
from ba_torchrl.tasks.workspace import Spacing, Workspace
from tests.tasks.episodes import slow_variants

WORKSPACE = Workspace((0.25, 0.65), (-0.1, 0.3), (0.0, 0.4))  # its centre is off the x axis
SIX_DOF = slow_variants(task for task, *_ in VARIANTS)
RAMPS = slow_variants(task for task, *_ in VARIANTS if task.startswith("ramp/"))


@pytest.fixture
def world():
    with World() as world:
        yield world


def make_ramps(world, seed=0):
    ramps = Ramps(world, WORKSPACE)
    world.seal()
    ramps.initialize_episode(np.random.default_rng(seed))
    return ramps


def make_bumps(world, seed=0):
    bumps = Bumps(world, WORKSPACE, (0.13, 0.1), random_orientation=True)
    world.seal()
    bumps.initialize_episode(np.random.default_rng(seed))
    return bumps


def cast_down(world, points):
    """Return height and normal of the first surface below each point, by rays."""
    world.detect_collisions()
    hits = pybullet.rayTestBatch(
        [(*p, 1.0) for p in points], [(*p, -0.1) for p in points], physicsClientId=world.client
    )
    return np.array([hit[3][2] for hit in hits]), np.array([hit[4] for hit in hits])


def bottom(body):
    """Return the vertices [V, 3] of the side on which a body started."""
    heights = body.shape.vertices[:, 2]
    return world_vertices(body)[heights < heights.min() + 1e-4]


def random_points(terrain, count, distance_m=1e-3):
    """Return points around which the surface is a plane."""
    rng = np.random.default_rng(1)
    low, high = np.array([terrain.workspace.x, terrain.workspace.y]).T
    points = rng.uniform(low, high, (count, 2))
    return points[terrain._planes(points, distance_m)[2] < 1e-9]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("make", "margin_m"),
    [(make_ramps, 1e-3), (make_bumps, 1.3e-3)],  # the accuracy of PyBullet's rays
)
def test_heights_and_normals_are_those_of_the_collision_shapes(world, make, margin_m, seed):
    terrain = make(world, seed)
    points = random_points(terrain, 300)
    assert len(points) > 200
    heights, normals = cast_down(world, points)
    assert np.ptp(heights) > 0.01
    assert terrain.heights_m(points) == pytest.approx(heights, abs=margin_m)
    for point, normal in zip(points.tolist(), normals, strict=True):
        pose = terrain.surface_pose(point, 0.7)
        rotation = np.array(quaternion_matrix(pose.orientation))
        assert rotation[:, 2] == pytest.approx(normal, abs=1e-3)
        assert math.atan2(rotation[1, 0], rotation[0, 0]) == pytest.approx(0.7)
        assert pose.position[2] == terrain.height_m(point)


@pytest.mark.parametrize("quarter", range(4))
def test_no_heading_of_the_ramps_is_singular(world, quarter):
    ramps = make_ramps(world)
    layout = RampLayout(quarter * math.pi / 2, (0.03, 0.07), (0.0, 0.01), (0.3, 0.5))
    ramps._set_layout(layout)
    points = random_points(ramps, 200)
    assert ramps.heights_m(points) == pytest.approx(cast_down(world, points)[0], abs=1e-3)
    x, y = WORKSPACE.center
    ahead = (math.cos(layout.heading_rad), math.sin(layout.heading_rad))
    left, right = (
        (x + side * -ahead[1] * 0.15, y + side * ahead[0] * 0.15) for side in (1.0, -1.0)
    )
    assert ramps.height_m(left) == pytest.approx(0.12 * math.tan(0.3))
    assert ramps.height_m(right) == pytest.approx(0.01 + 0.08 * math.tan(0.5))


def test_the_ramps_cover_the_ranges_of_the_paper(world):
    ramps, rng = make_ramps(world), np.random.default_rng(0)
    layouts = []
    for _ in range(400):
        ramps.initialize_episode(rng)
        layouts.append(ramps.layout)
    values = {
        "gap": [sum(layout.distances_m) for layout in layouts],
        "heading": [layout.heading_rad for layout in layouts],
        "edge": [edge for layout in layouts for edge in layout.edges_m],
        "slope": [slope for layout in layouts for slope in layout.slopes_rad],
    }
    ranges = {"gap": (0.04, 0.2), "heading": (0, 2 * math.pi), "edge": (0, 0.01)}
    ranges["slope"] = (0, math.pi / 6)
    for name, (low, high) in ranges.items():
        span = high - low
        assert low <= min(values[name]) < low + 0.05 * span
        assert high - 0.05 * span < max(values[name]) <= high
        assert np.mean(values[name]) == pytest.approx((low + high) / 2, abs=0.06 * span)
    offsets = [abs(a - b) / 2 for a, b in (layout.distances_m for layout in layouts)]
    assert 0.02 < max(offsets) <= 0.04


def test_the_pyramids_have_slopes_up_to_15_degrees_and_the_platform_their_height(world):
    bumps, rng = make_bumps(world), np.random.default_rng(0)
    slopes, headings = [], []
    for _ in range(60):
        bumps.initialize_episode(rng)
        slopes += [bumps.slopes_rad[i] for i in bumps.layout.pyramids]
        headings.append(bumps.layout.heading_rad)
    assert len(slopes) == 9 * 60
    assert min(slopes) < 0.01
    assert math.pi / 12 - 0.01 < max(slopes) < math.pi / 12
    assert np.mean(slopes) == pytest.approx(math.pi / 24, rel=0.05)
    assert max(headings) - min(headings) > 2.5
    assert bumps.top_m == pytest.approx(0.1 * math.tan(math.pi / 12))
    assert bumps.height_m(bumps.layout.platform[:2]) == bumps.top_m


def test_on_level_ground_the_least_height_of_the_tool_is_that_of_a_flat_floor(world):
    ramps, gripper = make_ramps(world), _gripper()
    ramps._set_layout(RampLayout(0.0, (0.1, 0.1), (0.0, 0.0), (0.0, 0.0)))
    flat = Flat(world, WORKSPACE)
    for rotation in (None, tool_rotation(0.4, 0.3, -0.2)):
        expected = flat.lowest_tool_m(gripper, (0.45, 0.1), rotation)
        lowest = ramps.lowest_tool_m(gripper, (0.45, 0.1), rotation)
        # the outer sides of tilted fingers are lower than the inner sides that Flat considers
        extra = 0.0 if rotation is None else gripper.finger_depth_m
        assert expected - 1e-12 <= lowest <= expected + extra + 1e-12


def _gripper():
    with World() as world:
        return Kuka(world).gripper


def test_a_tool_parallel_to_a_ramp_goes_lower_than_a_vertical_one(world):
    ramps, gripper = make_ramps(world), _gripper()
    slope = math.pi / 6
    ramps._set_layout(RampLayout(0.0, (0.05, 0.05), (0.0, 0.0), (slope, 0.0)))
    xy = (0.45, 0.1 + 0.12)  # on the ramp, which rises along +y
    across = ramps.lowest_tool_m(gripper, xy, tool_rotation(math.pi / 2))
    parallel = ramps.lowest_tool_m(gripper, xy, tool_rotation(math.pi / 2, -slope))
    assert parallel + 0.01 < across


@pytest.mark.parametrize("task", SIX_DOF)
def test_objects_start_at_rest_on_the_surface(make_env, task):
    env = make_env(task)
    tilts = []
    for _ in range(5):
        env.reset()
        scene = env.scene
        terrain = scene.task.terrain
        for body in scene.task.objects:
            gap = terrain.gap_below_m(body)
            assert -1.5e-3 < gap < 1.5e-3
            tilts.append(body.tilt_rad)
        assert not scene.robot.penetrates(terrain.support_ids, scene.robot.home_joints)
        poses = [body.pose for body in scene.task.objects]
        scene.world.step(60)
        for body, before in zip(scene.task.objects, poses, strict=True):
            assert math.dist(body.position, before.position) < 2e-3
    assert max(tilts) > 0.05


@pytest.mark.parametrize("task", RAMPS)
def test_objects_lie_flush_on_one_side_of_each_edge(make_env, task):
    env = make_env(task)
    between = 0
    for _ in range(8):
        env.reset()
        task_ = env.scene.task
        terrain = task_.terrain
        on_base = []
        for body, piece in task_.structure.pieces.items():
            _, across = terrain.frame.to_local(*bottom(body)[:, :2].T)
            first, second = terrain.layout.distances_m
            inside = (across < first).all() and (across > -second).all()
            assert inside or (across > first).all() or (across < -second).all()
            normal = quaternion_matrix(terrain.surface_pose(body.position[:2]).orientation)[2][2]
            # one of 30 random shapes rests on a facet beside the one it was placed on
            tolerance = 0.15 if piece.kind == "object" else 0.06
            assert body.tilt_rad == pytest.approx(math.acos(min(normal, 1.0)), abs=tolerance)
            if inside:
                on_base.append(piece.kind)
        assert task_.structure.blueprint.slots[0].piece.kind in on_base
        between += len(on_base)
    assert between < 8 * len(task_.structure.pieces)  # the others start on the ramps, too


@pytest.mark.parametrize("seed", range(3))
def test_the_lowest_plane_is_the_solution_of_the_linear_program(seed):
    rng = np.random.default_rng(seed)
    points, heights = rng.uniform(-1, 1, (60, 2)), rng.uniform(0, 0.3, 60)
    center = points[:3].mean(axis=0)
    slopes, height = lowest_plane(points, heights, center)
    # minimise the height at the centre, subject to: the plane is above every point
    rows = np.column_stack([points, np.ones(60)])
    solution = linprog([*center, 1.0], A_ub=-rows, b_ub=-heights, bounds=(None, None))
    assert slopes @ center + height == pytest.approx(solution.fun, abs=1e-9)
    assert (rows @ (*slopes, height) - heights).min() == pytest.approx(0.0, abs=1e-9)


def test_the_lowest_plane_of_three_points_is_theirs():
    points, heights = np.array([[0.0, 0.0], [0.05, 0.0], [0.0, 0.05]]), np.array([0.0, 0.3, 1.0])
    slopes, height = lowest_plane(points, heights, points.mean(axis=0))
    assert (*slopes, height) == pytest.approx((6.0, 20.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("height_m", [0.03, 0.06, 0.1, 0.2])
def test_a_body_stands_with_the_tilt_of_the_surface_even_if_it_topples(world, height_m):
    ramps = Ramps(world, WORKSPACE)
    box = world.add(Box(size_m=(0.03, 0.03, height_m)), "box")
    world.seal()
    ramps.heights_m = lambda points: 0.5 * points[:, 0]
    ramps.stand(box, (0.4, 0.0), 0.7)
    assert box.tilt_rad == pytest.approx(math.atan(0.5), abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_boxes_stand_on_bumps_where_physics_leaves_them(world, seed):
    bumps = Bumps(world, WORKSPACE, (0.13, 0.1), random_orientation=True)
    boxes = [world.add(Box(size_m=(0.03, 0.06, 0.03)), f"box {i}") for i in range(8)]
    world.seal()
    rng = np.random.default_rng(seed)
    bumps.initialize_episode(rng)
    spacings = [Spacing(0.06, 0.07)] * len(boxes)
    bumps.scatter(rng, boxes, spacings, lambda body: float(rng.uniform(0, math.pi)), base=boxes[0])
    for body in boxes:  # the poses before the physics steps of `scatter`
        bumps.stand(body, body.position[:2], body.yaw_rad)
    before = [world_vertices(body) for body in boxes]
    world.step(60)
    moved = [np.abs(world_vertices(b) - v).max() for b, v in zip(boxes, before, strict=True)]
    assert np.median(moved) < 5e-4
    assert max(moved) < 6e-3


def test_objects_start_beside_the_platform(make_env):
    env = make_env("bump/house_building_4")
    for _ in range(8):
        env.reset()
        frame = env.scene.task.terrain.layout.platform
        platform = Rectangle(*frame, 0.065, 0.065)
        for body in env.scene.task.objects:
            assert gap_m(platform, outline(body)) > 0.01


def test_a_workspace_smaller_than_the_platform_is_refused():
    with pytest.raises(ConfigError, match="the platform of"):
        ba_torchrl.make("bump/box_palletizing", workspace=((0.35, 0.6), (-0.125, 0.125), (0, 0.3)))


@pytest.mark.parametrize("width", [0.4, 0.7])
def test_the_ramps_cover_the_corners_of_any_workspace(world, width):
    workspace = Workspace((0.3, 0.3 + width), (-width / 2, width / 2), (0.0, 0.4))
    ramps = Ramps(world, workspace)
    world.seal()
    rng = np.random.default_rng(0)
    corners = np.array([(x, y) for x in workspace.x for y in workspace.y])
    for _ in range(40):
        ramps.initialize_episode(rng)
        plane = corners[ramps._planes(corners, 5e-3)[2] < 1e-9]
        assert len(plane) >= 2
        assert ramps.heights_m(plane) == pytest.approx(cast_down(world, plane)[0], abs=2e-3)


@pytest.mark.parametrize("task", ["ramp/block_stacking", "bump/house_building_4"])
def test_the_heightmap_shows_the_terrain(make_env, task):
    env = make_env(task, obs_size=64)
    image = env.reset()["heightmap"][0].numpy()
    terrain = env.scene.task.terrain
    x, y = (
        low + (high - low) * (np.arange(64) + 0.5) / 64
        for low, high in (env.workspace.x, env.workspace.y)
    )
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    ground = terrain.heights_m(points).reshape(64, 64)
    objects = np.zeros((64, 64), dtype=bool)
    for body in env.scene.task.objects:
        distance = np.hypot(*(points - body.position[:2]).T)
        objects |= (distance < 0.075).reshape(64, 64)
    difference = np.abs(image - ground)[~objects]
    assert (difference < 2e-3).mean() > 0.98  # all but pixels at an edge
    assert (image - ground)[objects].max() > 0.015


def test_an_object_on_a_ramp_is_grasped_along_its_normal(make_env):
    env = make_env("ramp/block_stacking", num_objects=2)
    tilted = 0
    for _ in range(12):
        state = env.reset()
        grasps = env.scene.task.grasps()
        command = env.actions.decode(state["expert_action"].numpy())
        body = min(
            env.scene.task.objects,
            key=lambda body: math.dist(body.position[:2], (command.x_m, command.y_m)),
        )
        approach = -np.array(tool_rotation(*command.angles_rad))[:, 2]
        normal = np.array(quaternion_matrix(body.pose.orientation))[:, 2]
        if body.tilt_rad > 0.1 and grasps.quality(body, grasps.best(body))[0] == 0:
            tilted += 1
            assert math.acos(min(approach @ normal, 1.0)) <= body.tilt_rad + 0.02
            if approach @ normal > 0.999:
                tilted += 10
    assert tilted > 30  # most grasps are exactly along the normal


def test_a_gap_narrower_than_the_pieces_is_refused(world):
    ramps = Ramps(world, WORKSPACE)
    ramps.reserve(0.1 - 2 * EDGE_MARGIN_M)
    world.seal()
    rng = np.random.default_rng(0)
    for _ in range(50):
        ramps.initialize_episode(rng)
        assert 0.1 <= sum(ramps.layout.distances_m) <= GAP_M[1]
    with pytest.raises(ValueError, match="wider"):
        Ramps(World(), WORKSPACE).reserve(0.25)


@pytest.mark.parametrize(
    ("attributes", "size"), [({}, "13 x 13 cm"), ({"platform_m": (0.2, 0.15)}, "20 x 15 cm")]
)
def test_a_row_on_bumps_has_a_platform_of_its_own_or_the_default_size(attributes, size):
    task = task_on("bump/house_building_2", HouseBuilding2, attributes)
    assert task.platform_m == attributes.get("platform_m", (0.13, 0.13))
    assert task.__doc__.startswith(f"House Building 2 on a platform of {size}, with")
