"""Action layouts: what the components of an action vector mean, in the environment's units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ba_torchrl.config import ConfigError


class GripperCommand(NamedTuple):
    """One close-loop action in physical units."""

    opening: float
    """Wanted opening of the gripper: 0 closed, 1 open."""
    dx_m: float
    dy_m: float
    dz_m: float
    dyaw_rad: float


class InvalidActionError(ValueError):
    """An action of the wrong shape, or one that is not finite."""


def wrap_angle(angle_rad: float, period_rad: float = 2 * math.pi) -> float:
    """Return the angle moved by whole periods into [-period/2, period/2)."""
    half = period_rad / 2
    return (angle_rad + half) % period_rad - half


@dataclass(frozen=True)
class CloseLoopActions:
    """The close-loop action vector: components in [-1, 1] in the order of ``sequence``.

    Args:
        sequence: one letter per component: p the gripper (1 open, -1 closed), x y z the
            displacement, r the change of yaw; r may be left out.
        dpos_m: displacement along an axis at 1.
        drot_rad: change of yaw at 1.

    Raises:
        ConfigError: a letter is missing, unknown or repeated.
    """

    sequence: str = "pxyzr"
    dpos_m: float = 0.05
    drot_rad: float = math.pi / 4

    def __post_init__(self) -> None:
        if sorted(self.sequence) not in (sorted("pxyz"), sorted("pxyzr")):
            raise ConfigError(
                f"action_sequence {self.sequence!r} does not suit a close-loop task: it takes the "
                "letters p, x, y, z once each and r at most once, as in 'pxyzr' or 'pxyz'"
            )

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.sequence)

    @property
    def has_yaw(self) -> bool:
        """Whether the gripper can be turned."""
        return "r" in self.sequence

    def decode(self, action: np.ndarray) -> GripperCommand:
        """Return the command of ``action`` ([size], clipped to [-1, 1])."""
        value = dict(zip(self.sequence, np.clip(action, -1.0, 1.0).tolist(), strict=True))
        return GripperCommand(
            opening=0.5 * (value["p"] + 1.0),
            dx_m=value["x"] * self.dpos_m,
            dy_m=value["y"] * self.dpos_m,
            dz_m=value["z"] * self.dpos_m,
            dyaw_rad=value.get("r", 0.0) * self.drot_rad,
        )

    def encode(self, command: GripperCommand) -> np.ndarray:
        """Return the action [size] float32 of ``command``, each component clipped to [-1, 1]."""
        value = {
            "p": 2.0 * command.opening - 1.0,
            "x": command.dx_m / self.dpos_m,
            "y": command.dy_m / self.dpos_m,
            "z": command.dz_m / self.dpos_m,
            "r": command.dyaw_rad / self.drot_rad,
        }
        action = np.array([value[letter] for letter in self.sequence], dtype=np.float32)
        return np.clip(action, -1.0, 1.0)
