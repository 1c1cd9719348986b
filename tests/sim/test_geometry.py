"""Rotations, poses and planar frames, compared with SciPy rotations and homogeneous matrices."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ba_torchrl.sim.geometry import (
    IDENTITY,
    PlanarFrame,
    Pose,
    cross,
    dot,
    downward,
    downward_quaternion,
    euler_matrix,
    matrix_quaternion,
    perpendicular,
    quaternion_matrix,
    quaternion_product,
    quaternion_tilt,
    quaternion_yaw,
    rotation_array,
    surface_quaternion,
    tool_angles,
    tool_rotation,
    yaw_quaternion,
)

ANGLES = [(0.3, 0.0, 0.0), (-2.0, 0.4, -0.7), (1.0, -0.2, 0.5), (3.0, 1.2, -2.8), (0.0, 0.0, 0.0)]
FLIP = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


@pytest.fixture(params=range(2))
def rng(request):
    return np.random.default_rng(request.param)


def random_pose(rng):
    turn = Rotation.random(random_state=int(rng.integers(2**31)))
    return Pose(tuple(rng.normal(size=3).tolist()), tuple(turn.as_quat().tolist()))


def homogeneous(pose):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(pose.orientation).as_matrix()
    matrix[:3, 3] = pose.position
    return matrix


def is_same(pose, matrix):
    np.testing.assert_allclose(homogeneous(pose), matrix, atol=1e-12)


@pytest.mark.parametrize("angles", ANGLES)
def test_rotation_matrices_of_angles_and_quaternions(angles):
    turn = Rotation.from_euler("ZYX", angles)
    quaternion = tuple(turn.as_quat())
    np.testing.assert_allclose(euler_matrix(*angles), turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(quaternion_matrix(quaternion), turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation_array(quaternion), turn.as_matrix(), atol=1e-12)
    x_axis, _, z_axis = turn.as_matrix().T
    assert quaternion_yaw(quaternion) == pytest.approx(math.atan2(x_axis[1], x_axis[0]))
    assert quaternion_tilt(quaternion) == pytest.approx(math.acos(z_axis[2]), abs=1e-7)


def test_quaternion_product(rng):
    first, second = (Rotation.from_quat(random_pose(rng).orientation) for _ in range(2))
    product = quaternion_product(tuple(first.as_quat()), tuple(second.as_quat()))
    np.testing.assert_allclose(rotation_array(product), (first * second).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("angles", ANGLES)
def test_tool_rotation_and_tool_angles(angles):
    tool = Rotation.from_euler("ZYX", angles) * FLIP
    np.testing.assert_allclose(tool_rotation(*angles), tool.as_matrix(), atol=1e-12)
    assert tool_angles(tuple(tool.as_quat())) == pytest.approx(angles, abs=1e-9)
    down = (Rotation.from_euler("z", angles[0]) * FLIP).as_matrix()
    np.testing.assert_allclose(downward(angles[0]), down, atol=1e-12)
    np.testing.assert_allclose(quaternion_matrix(downward_quaternion(angles[0])), down, atol=1e-12)
    assert yaw_quaternion(angles[0]) == pytest.approx(Rotation.from_euler("z", angles[0]).as_quat())


def test_pose_compose_and_inverse(rng):
    outer, inner = random_pose(rng), random_pose(rng)
    is_same(outer.compose(inner), homogeneous(outer) @ homogeneous(inner))
    is_same(outer.inverse(), np.linalg.inv(homogeneous(outer)))
    is_same(outer.compose(outer.inverse()), np.eye(4))
    is_same(Pose((1.0, 2.0, 3.0)).compose(outer), homogeneous(outer) + _shift(1.0, 2.0, 3.0))
    assert Pose((0.0, 0.0, 0.0)).orientation == IDENTITY


def _shift(x, y, z):
    shift = np.zeros((4, 4))
    shift[:3, 3] = x, y, z
    return shift


def test_pose_apply_and_rotate(rng):
    pose, points = random_pose(rng), rng.normal(size=(4, 2, 3))
    matrix = homogeneous(pose)
    expected = np.einsum("ij,abj->abi", matrix[:3, :3], points)
    np.testing.assert_allclose(pose.rotate(points), expected, atol=1e-12)
    np.testing.assert_allclose(pose.apply(points), expected + matrix[:3, 3], atol=1e-12)


def test_pose_moved_to(rng):
    pose = random_pose(rng)
    moved = pose.moved_to((0.1, 0.2, 0.3), 0.7)
    turn = Rotation.from_euler("z", 0.7) * Rotation.from_quat(pose.orientation)
    assert moved.position == (0.1, 0.2, 0.3)
    np.testing.assert_allclose(rotation_array(moved.orientation), turn.as_matrix(), atol=1e-12)
    assert pose.moved_to((0.1, 0.2, 0.3)).orientation == pose.orientation
    x_axis = turn.as_matrix()[:, 0]
    assert moved.yaw_rad == pytest.approx(math.atan2(x_axis[1], x_axis[0]))


def test_planar_frame_to_world_and_to_local(rng):
    x, y, yaw, px, py = rng.normal(size=5).tolist()
    frame = PlanarFrame(x, y, yaw)
    expected = complex(x, y) + complex(px, py) * complex(math.cos(yaw), math.sin(yaw))
    assert frame.to_world(px, py) == pytest.approx((expected.real, expected.imag))
    assert frame.to_local(expected.real, expected.imag) == pytest.approx((px, py))
    many = np.array([px, 0.0]), np.array([py, 0.0])
    np.testing.assert_allclose(frame.to_world(*many), [(expected.real, x), (expected.imag, y)])


def test_dot_cross_and_perpendicular():
    a, b = (0.3, -1.0, 2.0), (1.5, 0.2, -0.4)
    assert dot(a, b) == pytest.approx(np.dot(a, b))
    assert cross(a, b) == pytest.approx(np.cross(a, b))
    across = perpendicular(a, (0.0, 0.0, 1.0))
    assert across == pytest.approx((0.3 / math.hypot(0.3, 1.0), -1.0 / math.hypot(0.3, 1.0), 0.0))
    assert perpendicular((0.0, 0.0, 2.0), (0.0, 0.0, 1.0)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("seed", range(8))
def test_matrices_and_quaternions_are_inverse(seed):
    x = np.random.default_rng(seed).normal(size=4)
    x[seed % 4] *= 10.0  # each component is the largest one in some case
    quaternion = x / np.linalg.norm(x)
    found = np.array(matrix_quaternion(quaternion_matrix(tuple(quaternion.tolist()))))
    assert abs(found @ quaternion) == pytest.approx(1.0)


@pytest.mark.parametrize("turn", [(math.pi, 0, 0), (0, math.pi, 0), (0, 0, math.pi), (0, 0, 0)])
def test_half_turns_have_a_quaternion(turn):
    matrix = euler_matrix(*turn)
    found = quaternion_matrix(matrix_quaternion(matrix))
    assert np.array(found) == pytest.approx(np.array(matrix), abs=1e-12)


@pytest.mark.parametrize("yaw", [0.0, -2.5, math.pi])
@pytest.mark.parametrize(("slope", "bearing"), [(0.0, 0.0), (0.1, 0.7), (1.2, -2.0)])
def test_a_frame_on_a_surface_has_its_normal_and_heading(yaw, slope, bearing):
    normal = (
        math.sin(slope) * math.cos(bearing),
        math.sin(slope) * math.sin(bearing),
        math.cos(slope),
    )
    matrix = np.array(quaternion_matrix(surface_quaternion(normal, yaw)))
    assert matrix[:, 2] == pytest.approx(normal, abs=1e-12)
    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    heading = math.atan2(matrix[1, 0], matrix[0, 0])
    assert math.cos(heading - yaw) == pytest.approx(1.0)
