"""Action vectors of both controls, and the commands in physical units that they encode."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ba_torchrl.core.errors import ConfigError


class GripperCommand(NamedTuple):
    """One close-loop action in physical units."""

    opening: float
    """Target opening of the gripper: 0 closed, 1 open."""
    dx_m: float
    dy_m: float
    dz_m: float
    dyaw_rad: float


class PickPlaceCommand(NamedTuple):
    """One open-loop action in physical units; the tool's rotation is Rz(rz) Ry(ry) Rx(rx)."""

    primitive: int | None
    """`PICK` or `PLACE`; None: place if an object is held, else pick."""
    x_m: float
    y_m: float
    z_m: float | None
    """None: computed from the heightmap."""
    rz_rad: float = 0.0
    ry_rad: float = 0.0
    rx_rad: float = 0.0

    @property
    def angles_rad(self) -> tuple[float, float, float]:
        """The angles rz, ry and rx."""
        return self.rz_rad, self.ry_rad, self.rx_rad


PICK, PLACE = 0, 1


def wrap_angle(angle_rad: float, period_rad: float = 2 * math.pi) -> float:
    """Return the angle moved by whole periods into [-period/2, period/2)."""
    half = period_rad / 2
    return (angle_rad + half) % period_rad - half


class _Sequence:
    sequence: str

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.sequence)

    @property
    def turns(self) -> list[int]:
        """Indices of the components that turn the gripper."""
        return [i for i, letter in enumerate(self.sequence) if letter == "r"]


@dataclass(frozen=True)
class CloseLoopActions(_Sequence):
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
                f"action_sequence {self.sequence!r} does not fit a close-loop task: it needs the "
                "letters p, x, y, z once each and r at most once, as in 'pxyzr' or 'pxyz'"
            )

    @property
    def components(self) -> list[str]:
        """Name of each component: p, x, y, z or rz."""
        return ["rz" if letter == "r" else letter for letter in self.sequence]

    @property
    def primitive(self) -> None:
        """None: the letter p is the opening of the gripper."""
        return None

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
        """Return the action [size] float32 of ``command``, each component clipped to [-1, 1].

        A horizontal displacement beyond the limit is scaled to it. This keeps its direction, so
        that the actions of an expert rotate with the scene.
        """
        scale = max(self.dpos_m, abs(command.dx_m), abs(command.dy_m))
        value = {
            "p": 2.0 * command.opening - 1.0,
            "x": command.dx_m / scale,
            "y": command.dy_m / scale,
            "z": command.dz_m / self.dpos_m,
            "r": command.dyaw_rad / self.drot_rad,
        }
        action = np.array([value[letter] for letter in self.sequence], dtype=np.float32)
        return np.clip(action, -1.0, 1.0)


ANGLES = {0: (), 1: ("rz",), 2: ("rz", "rx"), 3: ("rz", "ry", "rx")}
"""The angles that the letters r of an open-loop sequence denote, by their number."""

TILTS = ("ry", "rx")
"""The angles that change sign when half a turn about the tool's own axis swaps its fingers."""

MAX_TILT_RAD = math.pi / 2


class GridAxis(NamedTuple):
    """Equally spaced values of an action's component; index i stands for first + i * step."""

    first: float
    step: float
    count: int
    period: float | None = None
    """Period of an angle; None for other components."""


@dataclass(frozen=True)
class OpenLoopActions(_Sequence):
    """The open-loop action vector: a pose to pick from or place at, in metres and radians.

    Args:
        sequence: one letter per component, in any order: p the primitive (0 pick, 1 place), x y z
            the position, and up to three r: rz, then rx, or rz, ry, rx. Only x and y are required.
        bounds_m: ranges of x, y and z, to which positions are clipped.
        half_rotation: wrap yaws into [0, pi] instead of [0, 2 pi]; the tilts change so that the
            fingers keep their pose.

    Raises:
        ConfigError: a letter is missing, unknown or repeated.
    """

    sequence: str
    bounds_m: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    half_rotation: bool = True

    def __post_init__(self) -> None:
        letters = self.sequence.replace("r", "")
        if (
            not {"x", "y"} <= set(letters) <= set("pxyz")
            or len(set(letters)) < len(letters)
            or self.sequence.count("r") > 3
        ):
            raise ConfigError(
                f"action_sequence {self.sequence!r} does not fit an open-loop task: it needs x "
                "and y once each, p and z at most once, and up to three r, as in 'pxyr'"
            )

    @property
    def components(self) -> list[str]:
        """Name of each component: p, x, y, z, rz, ry or rx."""
        angles = iter(ANGLES[self.sequence.count("r")])
        return [next(angles) if letter == "r" else letter for letter in self.sequence]

    @property
    def primitive(self) -> int | None:
        """Index of the primitive; None if there is none."""
        return self.sequence.index("p") if "p" in self.sequence else None

    @property
    def ranges(self) -> list[tuple[float, float]]:
        """Least and greatest value of each component."""
        turn = math.pi if self.half_rotation else 2 * math.pi
        named = {
            "p": (0.0, 1.0),
            **dict(zip("xyz", self.bounds_m, strict=True)),
            "rz": (0.0, turn),
            "ry": (-MAX_TILT_RAD, MAX_TILT_RAD),
            "rx": (-MAX_TILT_RAD, MAX_TILT_RAD),
        }
        return [named[name] for name in self.components]

    def decode(self, action: np.ndarray) -> PickPlaceCommand:
        """Return the command of ``action`` [size]; positions are clipped, angles wrapped.

        A primitive between 0 and 1 is rounded.
        """
        value = dict(
            zip(self.components, np.asarray(action, dtype=np.float64).tolist(), strict=True)
        )
        primitive = None
        if "p" in value:
            primitive = PICK if value["p"] < 0.5 else PLACE
        x, y, z = (
            min(max(value[name], low), high) if name in value else None
            for name, (low, high) in zip("xyz", self.bounds_m, strict=True)
        )
        rz, ry, rx = self.wrap(*(value.get(name, 0.0) for name in ("rz", "ry", "rx")))
        return PickPlaceCommand(primitive, x, y, z, rz, ry, rx)

    def encode(self, command: PickPlaceCommand) -> np.ndarray:
        """Return the action [size] float32 of a command, without components outside the sequence.

        Raises:
            ValueError: the command leaves a component of the sequence undefined.
        """
        rz, ry, rx = self.wrap(command.rz_rad, command.ry_rad, command.rx_rad)
        value = {
            "p": command.primitive,
            "x": command.x_m,
            "y": command.y_m,
            "z": command.z_m,
            "rz": rz,
            "ry": ry,
            "rx": rx,
        }
        missing = [name for name in self.components if value[name] is None]
        if missing:
            raise ValueError(f"the command leaves {', '.join(missing)} undefined")
        action = [
            min(max(value[name], low), high)
            for name, (low, high) in zip(self.components, self.ranges, strict=True)
        ]
        return np.array(action, dtype=np.float32)

    def axis(self, name: str, count: int, limits: tuple[float, float] | None = None) -> GridAxis:
        """Return the grid of a component.

        Args:
            name: of the component. x and y take the centres of pixels, so that an image of the
                workspace and the action share their grid; yaws start from zero; z and the tilts
                span their limits, ends included.
            count: number of values.
            limits: first and last value of z (metres) or a tilt (radians); None for the range of
                the component.

        Raises:
            ValueError: there is no such component, it takes no limits, or the limits are not
                increasing or exceed the component's range.
        """
        if name not in self.components or name == "p":
            raise ValueError(f"no grid for the component {name!r}")
        low, high = dict(zip(self.components, self.ranges, strict=True))[name]
        if name in ("x", "y", "rz"):
            if limits is not None:
                raise ValueError(f"the grid of {name} spans its whole range and takes no limits")
            step = (high - low) / count
            if name == "rz":
                return GridAxis(low, step, count, high - low)
            return GridAxis(low + step / 2, step, count)
        first, last = (low, high) if limits is None else limits
        # bounds may be rounded to float32
        if not low - 1e-6 <= first < last <= high + 1e-6:
            raise ValueError(
                f"the grid of {name} must increase within [{low:g}, {high:g}], got "
                f"[{first:g}, {last:g}]"
            )
        if count < 2:
            raise ValueError(f"the grid of {name} needs at least two values, got {count}")
        return GridAxis(first, (last - first) / (count - 1), count)

    def wrap(self, rz: float, ry: float, rx: float) -> tuple[float, float, float]:
        """Return the equivalent angles within the ranges; tilts are clipped to theirs.

        A half turn of the tool about its own axis swaps its fingers: it adds pi to the yaw and
        negates both tilts.
        """
        rz %= 2 * math.pi
        ry, rx = (min(max(wrap_angle(tilt), -MAX_TILT_RAD), MAX_TILT_RAD) for tilt in (ry, rx))
        if self.half_rotation and rz > math.pi:
            return rz - math.pi, -ry, -rx
        return rz, ry, rx
