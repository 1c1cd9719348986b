"""Limits of the controllers: speeds, accelerations, forces, distances and step counts."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class MotionLimits:
    """Limits of close-loop control."""

    contact_speed_m_s: float = 0.4
    """Maximum speed where contacts are possible and nothing is held."""
    contact_speed_rad_s: float = 6.0
    deceleration_m_s2: float = 4.0
    """Less than the floor's friction times gravity: otherwise a pushed body slides ahead."""
    held_time_s: float = 0.1
    """Duration of a displacement of 5 cm with a held body; it is proportional to the square root of
    the displacement."""
    max_vertical_force_n: float = 40.0
    """The tool yields when the sum of the vertical contact forces of the hand and the held body
    exceeds this."""
    max_lateral_force_n: float = 150.0
    """The same for the lateral contact forces."""
    yield_m: float = 1e-3
    """Displacement of a tool that yields."""
    press_stride_m: float = 5e-4
    """Displacement per step of a downward motion that starts in contact."""
    max_press_steps: int = 8
    path_sample_m: float = 0.01
    """Distance between the samples at which a path is checked for contacts."""
    path_sample_rad: float = 0.14
    path_margin_m: float = 1e-3
    """Distance of a contact point below which a sample is not free. Bullet has contact points of
    two boxes when they touch, and of other shapes from a distance of up to 0.8 mm."""
    max_slip_m: float = 5e-4
    """Displacement of a held body in the tool frame, perpendicular to the closing axis, above which
    it has slipped: in one simulated motion, or since then in all teleports. A cube has up to 0.2 mm
    in its first lift."""
    max_turn_rad: float = 0.02
    """The same for the rotation of a held body in the tool frame."""
    max_fall_fraction: float = 0.25
    """Displacement of a held body in the step after a teleport above which it slips, as a fraction
    of a falling body's."""
    max_regrasp_steps: int = 4
    """Maximum number of further physics steps in which a teleported body comes to rest in the
    gripper."""
    max_gripper_steps: int = 60
    """Maximum number of physics steps for opening or closing the gripper."""


@dataclass(frozen=True)
class PickPlaceLimits:
    """Limits of open-loop picks and places."""

    approach_distance_m: float = 0.1
    """Distance from the target, along the approach direction, at which an approach starts."""
    approach_samples_m: tuple[float, ...] = (0.06, 0.03)
    """Distances from the target at which an approach is checked for contacts, besides the target
    itself."""
    acceleration_m_s2: float = 25.0
    """Greatest acceleration of the tool in a simulated straight motion with an empty gripper."""
    held_acceleration_m_s2: float = 15.0
    """The same with a held body."""
    joint_acceleration_rad_s2: float = 60.0
    """Greatest acceleration of a joint in a simulated joint-space motion with an empty gripper."""
    held_joint_acceleration_rad_s2: float = 30.0
    """The same with a held body."""
    closing_stride: float = 0.075
    """Fraction of the opening between the samples at which closing fingers are checked for
    contacts."""
    max_closing_steps: int = 40
    grasp_settle_steps: int = 3
    """Physics steps after closing, in which the grasp force and the contact points build up."""
    lift_height_m: float = 0.005
    """Height by which a grasp is lifted before it is checked."""
    max_slip_m: float = 0.002
    """Displacement of a held body in the tool frame, in a simulated motion, above which it slips. A
    body that is accelerated by `held_acceleration_m_s2` alone lags by 3 mm behind the lift.
    Infinity: slipping is not tested."""
    min_motion_steps: int = 4
    """Least number of physics steps of a simulated straight motion."""
    transit_height_m: float = 0.3
    """Height of the tool between simulated joint-space motions and straight motions."""
    contact_margin_m: float = 5e-4
    """Distance to other bodies below which a pose is not free."""
    pre_place_height_m: float = 0.003
    """Distance from the target at which lowering a held body starts."""
    lowering_steps: int = 2
    release_rest_steps: int = 1
    """Physics steps after lowering in which a body that has no contact yet comes to rest in the
    gripper. Otherwise it would hit its support with the speed of the last step, and tilt."""
    release_opening: float = 0.12
    """Increase of the opening for a release."""
    max_release_steps: int = 10
    max_regrasp_steps: int = 5
    """Physics steps after which a body that is not grasped is no longer held."""
    max_vertical_force_n: float = 40.0
    """Sum of vertical contact forces at which a simulated downward motion stops."""

    @property
    def tests_slip(self) -> bool:
        """Whether a held body that slips is carried by simulation instead of teleports."""
        return math.isfinite(self.max_slip_m)
