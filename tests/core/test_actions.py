import math

import numpy as np
import pytest

from ba_torchrl.core.actions import (
    PICK,
    PLACE,
    CloseLoopActions,
    GripperCommand,
    OpenLoopActions,
    PickPlaceCommand,
    wrap_angle,
)
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.geometry import euler_matrix


def test_components_follow_the_sequence_and_are_scaled():
    layout = CloseLoopActions("rzyxp", dpos_m=0.02, drot_rad=0.5)
    command = layout.decode(np.array([1.0, -1.0, 0.5, 0.25, -1.0]))
    assert command == pytest.approx(GripperCommand(0.0, 0.005, 0.01, -0.02, 0.5))


def test_decoding_clips_and_encoding_inverts():
    layout = CloseLoopActions()
    assert layout.decode(np.array([3.0, -9, 0, 0, 0]))[:2] == (1.0, -0.05)
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, 5)
        np.testing.assert_allclose(layout.encode(layout.decode(action)), action, atol=1e-6)


@pytest.mark.parametrize("angle", np.linspace(-math.pi, math.pi, 17))
def test_encoding_keeps_the_direction_of_a_long_displacement(angle):
    layout = CloseLoopActions(dpos_m=0.05)
    command = GripperCommand(1.0, 0.3 * math.cos(angle), 0.3 * math.sin(angle), 0.2, 0.0)
    action = layout.encode(command)
    assert math.atan2(action[2], action[1]) == pytest.approx(angle, abs=1e-6)
    assert abs(action[1:3]).max() == pytest.approx(1.0)
    assert action[3] == 1.0
    short = layout.encode(GripperCommand(1.0, 0.05, -0.01, 0.0, 0.0))
    np.testing.assert_allclose(short[1:3], [1.0, -0.2], atol=1e-6)


def test_without_yaw_the_gripper_is_not_turned():
    layout = CloseLoopActions("pxyz")
    assert layout.size == 4
    assert not layout.has_yaw
    assert layout.decode(np.ones(4)).dyaw_rad == 0.0
    assert layout.encode(GripperCommand(1.0, 0, 0, 0, 0.3)).shape == (4,)


def test_wrap_angle():
    for angle in np.linspace(-20, 20, 101):
        for period in (math.pi / 2, math.pi, 2 * math.pi):
            wrapped = wrap_angle(angle, period)
            assert -period / 2 <= wrapped < period / 2
            turns = (angle - wrapped) / period
            assert turns == pytest.approx(round(turns), abs=1e-9)


# -- open loop ---------------------------------------------------------------------------------

BOUNDS = ((0.25, 0.65), (-0.2, 0.2), (0.0, 0.4))


def rotation(rz, ry, rx):
    return np.array(euler_matrix(rz, ry, rx))


@pytest.mark.parametrize("sequence", ["pxy", "pxyr", "pxyzrrr", "xyp", "rxyzp", "yx", "rrxyz"])
@pytest.mark.parametrize("half_rotation", [True, False])
def test_open_loop_encoding_inverts_decoding(sequence, half_rotation):
    layout = OpenLoopActions(sequence, BOUNDS, half_rotation)
    assert layout.size == len(sequence) == len(layout.ranges)
    rng = np.random.default_rng(0)
    low, high = np.array(layout.ranges).T
    for _ in range(50):
        action = rng.uniform(low, high)
        if "p" in sequence:
            action[sequence.index("p")] = rng.integers(2)
        np.testing.assert_allclose(layout.encode(layout.decode(action)), action, atol=1e-6)


@pytest.mark.parametrize(
    ("sequence", "components"),
    [
        ("pxy", "p x y"),
        ("pxyr", "p x y rz"),
        ("pxyzrr", "p x y z rz rx"),
        ("rrrzyxp", "rz ry rx z y x p"),
    ],
)
def test_letters_stand_for_components(sequence, components):
    layout = OpenLoopActions(sequence, BOUNDS)
    assert layout.components == components.split()
    named = {"p": 1.0, "x": 0.3, "y": 0.1, "z": 0.2, "rz": 0.5, "ry": -0.25, "rx": 0.75}
    command = layout.decode(np.array([named[name] for name in layout.components]))
    present = set(components.split())
    assert command.primitive == (PLACE if "p" in present else None)
    assert command[1:3] == (0.3, 0.1)
    assert command.z_m == (0.2 if "z" in present else None)
    assert command.angles_rad == tuple(
        named[name] if name in present else 0.0 for name in ("rz", "ry", "rx")
    )


@pytest.mark.parametrize("sequence", ["px", "xyy", "ppxy", "pxyq", "pxyrrrr", "", "pxyzz"])
def test_open_loop_sequences_that_make_no_sense_are_refused(sequence):
    with pytest.raises(ConfigError, match="action_sequence"):
        OpenLoopActions(sequence, BOUNDS)


def test_half_a_turn_swaps_the_fingers_and_nothing_else():
    layout = OpenLoopActions("pxyzrrr", BOUNDS)
    swap = rotation(math.pi, 0, 0)  # about the tool's own axis
    rng = np.random.default_rng(1)
    swapped = 0
    for _ in range(200):
        angles = rng.uniform((-7, -1.5, -1.5), (7, 1.5, 1.5))
        wrapped = layout.wrap(*angles.tolist())
        assert 0 <= wrapped[0] <= math.pi
        before, after = rotation(*angles), rotation(*wrapped)
        is_same = np.allclose(before, after, atol=1e-9)
        swapped += not is_same
        assert is_same or np.allclose(before @ swap, after, atol=1e-9)
    assert 50 < swapped < 150


def test_without_half_rotation_the_fingers_stay_apart():
    layout = OpenLoopActions("pxyr", BOUNDS, half_rotation=False)
    assert layout.ranges[-1] == (0.0, 2 * math.pi)
    rng = np.random.default_rng(2)
    for angle in rng.uniform(-20, 20, 50).tolist():
        np.testing.assert_allclose(
            rotation(*layout.wrap(angle, 0.1, -0.2)), rotation(angle, 0.1, -0.2), atol=1e-9
        )


def test_positions_are_clipped_and_primitives_rounded():
    layout = OpenLoopActions("pxyz", BOUNDS)
    assert layout.decode(np.array([0.4, 0.0, -9.0, 9.0])) == PickPlaceCommand(PICK, 0.25, -0.2, 0.4)
    assert layout.decode(np.array([0.6, 9.0, 9.0, -9.0])) == PickPlaceCommand(PLACE, 0.65, 0.2, 0.0)
    encoded = layout.encode(PickPlaceCommand(PLACE, 9.0, 0.0, -1.0))
    np.testing.assert_allclose(encoded, [1.0, 0.65, 0.0, 0.0])


def test_a_command_must_say_what_the_sequence_asks_for():
    layout = OpenLoopActions("pxyz", BOUNDS)
    with pytest.raises(ValueError, match="z"):
        layout.encode(PickPlaceCommand(PICK, 0.4, 0.0, None))
    with pytest.raises(ValueError, match="p"):
        layout.encode(PickPlaceCommand(None, 0.4, 0.0, 0.1))
    flat = OpenLoopActions("xyr", BOUNDS)
    np.testing.assert_allclose(flat.encode(PickPlaceCommand(None, 0.4, 0.0, None)), [0.4, 0.0, 0.0])


def test_tilts_are_wrapped_and_then_clipped():
    layout = OpenLoopActions("pxyzrrr", BOUNDS)
    assert layout.wrap(0.0, 2.0, 2 * math.pi + 0.1) == pytest.approx((0.0, math.pi / 2, 0.1))
    assert layout.wrap(0.0, -2.0, -0.3) == pytest.approx((0.0, -math.pi / 2, -0.3))


def test_indices_of_components():
    bounds = ((0.0, 1.0),) * 3
    assert CloseLoopActions("pxyzr").turns == [4]
    assert CloseLoopActions("pxyz").turns == []
    assert CloseLoopActions("pxyzr").primitive is None  # p is the opening
    assert OpenLoopActions("rxyrrp", bounds).turns == [0, 3, 4]
    assert OpenLoopActions("xyp", bounds).primitive == 2
    assert OpenLoopActions("xyr", bounds).primitive is None
