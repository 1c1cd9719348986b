"""Grasps and releases of the expert for structures, and ramps, with six degrees of freedom."""

import math

import numpy as np
import pytest

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.actions import PICK, PLACE, PickPlaceCommand
from ba_torchrl.sim.bodies import world_vertices
from ba_torchrl.sim.geometry import (
    Pose,
    matrix_quaternion,
    quaternion_product,
    rotation_array,
    surface_quaternion,
    tool_rotation,
    yaw_quaternion,
)
from ba_torchrl.tasks.six_dof import VARIANTS
from ba_torchrl.tasks.structures.pick_place_expert import PickPlaceExpert
from ba_torchrl.tasks.structures.piece_grasps import Tilted
from ba_torchrl.tasks.structures.pieces import CUBOID
from ba_torchrl.tasks.structures.planner import next_move
from ba_torchrl.tasks.terrain.ramps import EDGE_MARGIN_M, GAP_M
from tests.tasks.episodes import slow_variants

OFF_CENTRE_M = 0.025
IMPROVISED = "ramp/improvise_house_building_3"


def hold_off_centre(env, seed):
    """Hold the cuboid beside its centre, rolled about its length; return the state and cuboid."""
    state = env.reset(seed=seed)
    task = env.scene.task
    body = next(body for body in task.objects if body.name.startswith("cuboid"))
    x, y, z = body.position
    yaw = CUBOID.yaw_rad(body) % math.pi
    about_length = (0.0, math.sin(0.05), 0.0, math.cos(0.05))
    body.set_pose((x, y, z + 0.02), quaternion_product(yaw_quaternion(yaw), about_length))
    at = Pose((x, y, z), yaw_quaternion(yaw)).compose(Pose((0.0, OFF_CENTRE_M, 0.0))).position
    pick = env.actions.encode(PickPlaceCommand(PICK, *at[:2], z + 0.02, yaw))
    state = env.step(state.set(keys.ACTION, env.action_spec.zero() + pick))[keys.NEXT]
    assert env.scene.robot.held_body() is body
    in_tool = env.scene.robot.tool_frame().inverse().compose(body.pose)
    assert abs(in_tool.position[1]) > OFF_CENTRE_M / 2
    return body


@pytest.mark.parametrize("seed", range(3))
def test_a_piece_that_is_held_off_its_centre_is_released_at_its_position(make_env, seed):
    env = make_env("ramp/house_building_3", robot="panda")
    body = hold_off_centre(env, seed)
    task, robot = env.scene.task, env.scene.robot
    area, grasps = PickPlaceExpert(task.grasps()).placement_area(), task.grasps()
    move = next_move(task.structure.assigner(body), area, grasps)
    command = env.actions.decode(env.actions.encode(task.expert_command()))
    assert command.primitive == PLACE
    tool = Pose(command[1:4], matrix_quaternion(tool_rotation(*command.angles_rad)))
    released = tool.compose(robot.tool_frame().inverse().compose(body.pose))
    assert math.dist(released.position, move.position) < 2e-3


@pytest.mark.parametrize("robot", ["kuka", "ur5"])
@pytest.mark.parametrize("seed", range(3))
def test_centred_grasps_have_the_same_space_on_both_sides_of_a_shape(make_env, robot, seed):
    env = make_env(IMPROVISED, robot=robot)
    env.reset(seed=seed)
    grasps = env.scene.task.grasps()
    for body in env.scene.task.objects:
        centred = [c for c in grasps.candidates(body) if c.centering_m == 0]
        assert centred
        for candidate in centred:
            tool = grasps.tool_pose(body, candidate)
            position = np.subtract(tool.position, (0.0, 0.0, grasps._raise_m(body, candidate)))
            extents = (world_vertices(body) - position) @ rotation_array(tool.orientation)[:, 0]
            assert extents.min() == pytest.approx(-extents.max(), abs=1e-6)


def test_a_tilted_grasp_has_no_clearance_where_the_knuckles_touch_a_piece(make_env):
    env = make_env(IMPROVISED, robot="ur5_robotiq")
    env.reset(seed=0)
    grasps = env.scene.task.grasps()
    roof, cuboid = (
        next(body for body in env.scene.task.objects if body.name.startswith(name))
        for name in ("roof", "cuboid")
    )
    normal = (math.sin(0.3), 0.0, math.cos(0.3))
    roof.set_pose((0.45, 0.0, 0.1), surface_quaternion(normal, math.pi / 2))
    candidate = next(c for c in grasps.candidates(roof) if isinstance(c, Tilted))
    tool = grasps.tool_pose(roof, candidate)
    half_m = np.ptp(cuboid.shape.vertices[:, 0]) / 2
    # its side is beyond the fingers and below the palm
    at = tool.compose(Pose((0.066 + half_m, 0.0, -0.05))).position
    cuboid.set_pose(at, tool.orientation)
    (clearance_m,) = grasps.clearances_m(roof, [candidate], [cuboid], None)
    assert clearance_m < 0


@pytest.mark.parametrize(
    "task", slow_variants(task for task, *_ in VARIANTS if task.startswith("ramp/"))
)
def test_the_gap_is_drawn_by_the_pieces_of_the_episode(task):
    """From 4 cm, or what its lowest layer needs, to 20 cm, and not from the widest variant."""
    env = ba_torchrl.make(task, obs_size=16, seed=0)
    gaps, shares = [], []
    for _ in range(60):
        env.reset()
        built = env.scene.task.structure
        lowest = {slot.piece.kind for slot in built.blueprint.slots if not slot.on}
        widths = []
        for piece in built.pieces.values():
            if piece.kind in lowest:
                yaw = piece.grasp_yaws_rad[0]
                axis = math.cos(yaw), math.sin(yaw)
                widths.append(np.ptp(piece.shape.vertices[:, :2] @ axis))
        least = max(GAP_M[0], max(widths) + 2 * EDGE_MARGIN_M)
        gaps.append(sum(env.scene.task.terrain.layout.distances_m))
        shares.append((gaps[-1] - least) / (GAP_M[1] - least))
    assert min(gaps) < 0.07
    assert 0 <= min(shares) < 0.1
    assert 0.9 < max(shares) <= 1
    env.close()
