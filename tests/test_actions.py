import math

import numpy as np
import pytest

from ba_torchrl.actions import CloseLoopActions, GripperCommand, wrap_angle


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
