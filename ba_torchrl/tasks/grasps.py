"""Top-down grasps of objects in a heap, planned from their shapes and a height image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np

from ba_torchrl.actions import wrap_angle
from ba_torchrl.sim.assets.hulls import surface_samples
from ba_torchrl.sim.bodies import Body, Vector
from ba_torchrl.sim.cameras import HeightCamera
from ba_torchrl.sim.robots.base import Pose
from ba_torchrl.tasks.base import Reach, Workspace
from ba_torchrl.tasks.experts import turned

HALF_GAP_M = 0.04
"""Half the distance between the open fingers."""
SPARE_M = 0.007
"""Room between an open finger and what it closes on; less is a risk."""
LEAST_SPARE_M = 0.002
BAND_HALF_M = 0.0125
"""Half the fingers' width."""
TIP_M = 0.0107
"""The fingertips end this far below the tool point."""
OUTLINE = ((0.038, -TIP_M), (0.044, -TIP_M), (0.051, -0.004), (0.058, 0.01), (0.065, 0.03))
"""Half distances at which an open finger's lower side is at a height above the tool point."""
CLEARANCE_M = 4.5e-3
DEEPEST_M = 0.035
"""Height of what is grasped above the tool point at most: more would meet the palm."""
SHALLOWEST_M = 0.006
"""Least height of what is between the fingers above their tips."""
LEAST_SQUARE = 0.3
"""How nearly opposite the surfaces that the fingers meet are at least."""

WORST_RISK = 4.0
"""Stands for no grasp at all."""
MET_M = 3e-3
"""Fingers meet what is this near to the outermost point between them."""

YAWS = 16
SAMPLES = 256
PIXEL_M = 0.003
BORDER_M = 0.06
"""The height image reaches this far beyond the workspace."""


class Grasp(NamedTuple):
    """A tool pose around an object."""

    body: Body
    position: Vector
    yaw_rad: float
    risk: float
    """0 for parallel sides in easy reach; beyond 1, rather not."""
    cost: float
    """Actions it takes, failures counted in."""


class GraspPlanner:
    """Finds the cheapest grasp in a heap.

    Args:
        pool: everything that may have to be grasped.
        camera: sees everything that may be in the way.
        workspace: where the tool may go.
    """

    def __init__(self, pool: Sequence[Body], camera: HeightCamera, workspace: Workspace) -> None:
        self._camera = camera
        self.workspace = workspace
        self._samples: dict[int, np.ndarray] = {}
        self._pool = pool
        x, y = workspace.center
        self._side_m = max(workspace.x[1] - workspace.x[0], workspace.y[1] - workspace.y[0])
        self._side_m += 2 * BORDER_M
        self.corner = (x - self._side_m / 2, y - self._side_m / 2)

        pixels = round(self._side_m / PIXEL_M)
        self._plain = np.zeros((pixels, pixels))

    def heights(self) -> np.ndarray:
        """Return the height image that grasps are checked against, metres."""
        pixels = round(self._side_m / PIXEL_M)
        return self._camera.heightmap(self.workspace.center, self._side_m, pixels)

    def plan(
        self, bodies: Sequence[Body], tool: Pose, reach: Reach, heights: np.ndarray
    ) -> Grasp | None:
        """Return the cheapest grasp of any of the bodies, or None if there is none.

        Args:
            bodies: to choose from.
            tool: where the gripper is.
            reach: of one action.
            heights: from `heights`.
        """
        (x, y, z), yaw = tool
        yaws = np.arange(YAWS) * np.pi / YAWS if reach.turn_rad else np.array([yaw])
        best = None
        low, high = self.workspace.z
        for body in bodies:
            found = _search(
                self.placed_samples(body),
                np.array(body.position),
                yaws,
                heights,
                np.array(self.corner),
                low,
                high,
            )
            for row in found:
                gx, gy, gz, risk = row[0], row[1], row[2], row[4]
                if not (
                    self.workspace.x[0] <= gx <= self.workspace.x[1]
                    and self.workspace.y[0] <= gy <= self.workspace.y[1]
                ):
                    continue
                target_yaw = turned(yaw, row[3], reach, math.pi)
                turn = abs(wrap_angle(target_yaw - yaw))
                aside = max(abs(gx - x), abs(gy - y))
                travel = max(aside / reach.step_m, turn / reach.turn_rad if reach.turn_rad else 0)
                travel += max(z - gz, 0.0) / reach.step_m
                if aside > 0.015 or turn > 0.3:
                    travel += max(0.1 - z, 0.0) / reach.step_m  # up first
                cost = travel + 12 * risk
                if best is None or cost < best.cost:
                    best = Grasp(body, (gx, gy, gz), target_yaw, float(risk), float(cost))
        return best

    def risk_alone(self, samples: np.ndarray, tool: Pose) -> float:
        """Return the least risk of a grasp, at the gripper's yaw, of a body with nothing near.

        Args:
            samples: from `placed_samples`, or moved from there.
            tool: where the gripper is.
        """
        low, high = self.workspace.z
        found = _search(
            samples,
            samples[:, :3].mean(axis=0),
            np.array([tool[1]]),
            self._plain,
            np.array(self.corner),
            low,
            high,
        )
        return min(float(found[:, 4].min()), WORST_RISK) if len(found) else WORST_RISK

    def placed_samples(self, body: Body) -> np.ndarray:
        """Return points on a body's surface and their normals as it lies now, [N, 6]."""
        key = id(body.shape)
        if key not in self._samples:
            self._samples[key] = np.hstack(surface_samples(body.shape.mesh(), SAMPLES))
        local = self._samples[key]
        position, quaternion = body.pose
        rotation = _rotation(quaternion)
        placed = np.empty_like(local)
        placed[:, :3] = local[:, :3] @ rotation.T + position
        placed[:, 3:] = local[:, 3:] @ rotation.T
        return placed


def _rotation(quaternion: tuple[float, float, float, float]) -> np.ndarray:
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


_OUTLINE_U = np.array([u for u, _ in OUTLINE])
_OUTLINE_Z = np.array([z for _, z in OUTLINE])
_BAND = np.array([-BAND_HALF_M, 0.0, BAND_HALF_M])
_OFFSETS_V = np.array([0.0, -0.012, 0.012, -0.024, 0.024])
_OFFSETS_U = np.array([0.0, -0.02, 0.02, -0.04, 0.04])


@numba.njit(cache=True)
def _height(heights, corner, x, y):  # noqa: ANN001, ANN202 -- compiled
    i = int((x - corner[0]) / PIXEL_M)
    j = int((y - corner[1]) / PIXEL_M)
    if i < 0 or j < 0 or i >= heights.shape[0] or j >= heights.shape[1]:
        return 1.0
    return heights[i, j]


@numba.njit(cache=True)
def _search(samples, center, yaws, heights, corner, low_z, high_z):  # noqa: ANN001, ANN202
    """Return the feasible grasps of one body, [N, 5]: x, y, z, yaw, risk between 0 and 1."""
    found = np.empty((yaws.shape[0] * _OFFSETS_V.shape[0] * _OFFSETS_U.shape[0], 5))
    count = 0
    n = samples.shape[0]
    u = np.empty(n)
    v = np.empty(n)
    met = np.empty(n, dtype=np.bool_)
    left_n, right_n = np.empty(4), np.empty(4)
    top = samples[:, 2].max()
    for yaw in yaws:
        cos, sin = math.cos(yaw), math.sin(yaw)
        for k in range(n):
            dx, dy = samples[k, 0] - center[0], samples[k, 1] - center[1]
            u[k] = cos * dx + sin * dy
            v[k] = cos * dy - sin * dx
        for v0 in _OFFSETS_V:
            for u0 in _OFFSETS_U:
                # what the fingers would close on, and how high it is
                lowest_u, highest_u, peak = 1.0, -1.0, 0.0
                for k in range(n):
                    if abs(v[k] - v0) <= BAND_HALF_M and abs(u[k] - u0) < HALF_GAP_M:
                        lowest_u, highest_u = min(lowest_u, u[k]), max(highest_u, u[k])
                        peak = max(peak, samples[k, 2])
                if highest_u < lowest_u or highest_u - lowest_u > 2 * (HALF_GAP_M - LEAST_SPARE_M):
                    continue
                middle = (highest_u + lowest_u) / 2
                if u0 != 0.0 and abs(middle - u0) > 0.012:
                    continue  # another offset finds the same
                x = center[0] + cos * middle - sin * v0
                y = center[1] + sin * middle + cos * v0
                # as low as floor, neighbours and palm allow
                z = max(low_z + 0.002, peak - DEEPEST_M)
                for s in range(-1, 2, 2):
                    for m in range(_OUTLINE_U.shape[0]):
                        for w in _BAND:
                            fu = s * _OUTLINE_U[m]
                            h = _height(
                                heights, corner, x + cos * fu - sin * w, y + sin * fu + cos * w
                            )
                            z = max(z, h - _OUTLINE_Z[m] + CLEARANCE_M)
                depth = peak - (z - TIP_M)
                if depth < SHALLOWEST_M or z > high_z:
                    continue
                # what else is between the fingers, and the palm
                blocked = False
                for w in _BAND:
                    for m in range(-2, 3):
                        fu = m * 0.015
                        h = _height(heights, corner, x + cos * fu - sin * w, y + sin * fu + cos * w)
                        if h > z + 0.05:
                            blocked = True
                        if h > peak + 0.01:
                            blocked = True  # something lies on it
                if blocked:
                    continue
                # what the fingers would close on besides
                crowd = 0
                for s in range(-1, 2, 2):
                    edge = highest_u - middle + 0.006
                    for m in range(3):
                        for w in _BAND:
                            fu = s * (edge + (HALF_GAP_M - edge) * m / 3)
                            h = _height(
                                heights, corner, x + cos * fu - sin * w, y + sin * fu + cos * w
                            )
                            crowd += h > z
                # surfaces that the fingers meet
                left, right = 1.0, -1.0
                for k in range(n):
                    met[k] = (
                        abs(v[k] - v0) <= BAND_HALF_M
                        and abs(u[k] - middle) < HALF_GAP_M
                        and samples[k, 2] > z - TIP_M
                    )
                    if met[k]:
                        left, right = min(left, u[k]), max(right, u[k])
                if right < left:
                    continue
                left_n[:] = 0.0
                right_n[:] = 0.0
                for k in range(n):
                    if met[k] and u[k] < left + MET_M:
                        left_n[:3] += samples[k, 3:]
                        left_n[3] += 1.0
                    if met[k] and u[k] > right - MET_M:
                        right_n[:3] += samples[k, 3:]
                        right_n[3] += 1.0
                left_n /= left_n[3]
                right_n /= right_n[3]
                square = -(left_n[0] * right_n[0] + left_n[1] * right_n[1] + left_n[2] * right_n[2])
                facing = min(
                    cos * right_n[0] + sin * right_n[1], -cos * left_n[0] - sin * left_n[1]
                )
                if square < LEAST_SQUARE or facing < LEAST_SQUARE:
                    continue
                risk = 2.5 * (1 - square) + 1.5 * max(0.0, 0.75 - facing)
                spare = HALF_GAP_M - (highest_u - lowest_u) / 2
                risk += 0.4 * max(0.0, SPARE_M - spare) / SPARE_M
                risk += 0.1 * crowd
                risk += 0.3 * max(0.0, 0.025 - depth) / 0.015
                risk += 6 * (abs(v0) + 0.5 * abs(middle))
                risk += 0.5 * max(0.0, top - peak) / 0.02
                found[count, 0], found[count, 1], found[count, 2] = x, y, z
                found[count, 3], found[count, 4] = yaw, risk
                count += 1
    return found[:count]
