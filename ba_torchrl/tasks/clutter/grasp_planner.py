"""Top-down grasps of objects in a heap, from their shapes and a height image."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ba_torchrl.core.actions import wrap_angle
from ba_torchrl.core.jit import njit
from ba_torchrl.sim.assets.hulls import surface_samples
from ba_torchrl.sim.bodies import Body
from ba_torchrl.sim.geometry import YawPose
from ba_torchrl.sim.robots.gripper import Gripper
from ba_torchrl.sim.vision.depth import HeightCamera
from ba_torchrl.tasks.manipulation.primitives import nearest_equivalent_yaw
from ba_torchrl.tasks.manipulation.top_down_grasps import TopDownGrasp
from ba_torchrl.tasks.workspace import ActionLimits, Workspace

SIDE_GAP_M = 0.007
"""Gap between an open finger and the object below which the risk increases."""
LEAST_SIDE_GAP_M = 0.002
"""Least gap between an open finger and the object."""
FLANK_MARGIN_M = 3e-3
"""Margin on both flanks of a finger: a pixel of the height image."""
CLEARANCE_M = 4.5e-3
"""Gap between fingers or palm and what is below them."""
DEEPEST_M = 0.047
"""Largest height of the top of an object above the fingertips; deeper grasps are no better."""
OBSTACLE_M = 0.012
"""Height above the fingertips from which an object obstructs the closing fingers."""
SHALLOWEST_M = 0.006
"""Least height of the top of an object above the fingertips."""
LEAST_COSINE = 0.3
"""Least cosine between a contact surface and the opposite one, or the finger."""

PATCH_M = 0.01
"""Width of a contact patch that prevents rotation of the object between the fingers. On an edge or
a corner it rotates until it slips out."""

WORST_RISK = 4.0
"""Risk of a body without a grasp."""
CONTACT_DEPTH_M = 3e-3
"""Depth behind the outermost point in which surface points touch a finger."""

YAWS = 16
"""Yaws per half turn that are compared."""
SAMPLES = 256
"""Number of sampled points of a surface."""
SAMPLES_PER_ACTION = 6
"""Poses per action at which the way to a grasp is compared with the height image."""
PIXEL_M = 0.003
"""Width of a pixel of the height image."""
BORDER_M = 0.06
"""Width of the border of the height image around the workspace."""


class GraspPlanner:
    """Finds the grasp with the lowest cost in a heap.

    Args:
        pool: all bodies that may be grasped.
        camera: camera of the height image, in which all obstacles are visible.
        workspace: bounds of the tool.
    """

    def __init__(
        self, pool: Sequence[Body], camera: HeightCamera, workspace: Workspace, gripper: Gripper
    ) -> None:
        self._camera = camera
        self.workspace = workspace
        self.gripper = gripper
        self.band_half_m = gripper.half_width_m + FLANK_MARGIN_M
        """Half the width of the band that the fingers occupy, with margins."""
        outline = np.array(sorted(gripper.outline, key=lambda point: point[1]))
        self._jaws = _Jaws(
            half_gap=gripper.half_gap_m,
            band_half=self.band_half_m,
            palm=gripper.palm_height_m,
            depth=gripper.finger_depth_m,
            arc_u=np.array([u for u, _ in gripper.tip_arc]),
            arc_z=np.array([z for _, z in gripper.tip_arc]),
            outline_u=outline[:, 0].copy(),
            outline_z=outline[:, 1].copy(),
        )
        self._samples: dict[int, np.ndarray] = {}
        self._pool = pool
        x, y = workspace.center
        self._side_m = max(workspace.x[1] - workspace.x[0], workspace.y[1] - workspace.y[0])
        self._side_m += 2 * BORDER_M
        self.corner = (x - self._side_m / 2, y - self._side_m / 2)
        """Corner of the height image with the least x and y."""

        pixels = round(self._side_m / PIXEL_M)
        self._empty_image = np.zeros((pixels, pixels))

    def heights(self) -> np.ndarray:
        """Return the height image that grasps are checked against, metres."""
        pixels = round(self._side_m / PIXEL_M)
        return self._camera.heightmap(self.workspace.center, self._side_m, pixels)

    def plan(
        self,
        bodies: Sequence[Body],
        tool: YawPose,
        limits: ActionLimits,
        heights: np.ndarray,
        penalty: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> TopDownGrasp | None:
        """Return the grasp of any of the bodies with the lowest cost; None without a grasp.

        Args:
            heights: height image of `heights`.
            penalty: returns the additional costs [N] of grasps [N, 6]: x, y, z, yaw, risk, slip.
        """
        (x, y, z), yaw = tool
        yaws = np.arange(YAWS) * np.pi / YAWS if limits.turn_rad else np.array([yaw])
        best = None
        for body in bodies:
            samples, center = self.placed_samples(body), np.array(body.position)
            found = self._grasps(samples, center, yaws, heights)
            penalties = np.zeros(len(found)) if penalty is None else penalty(found)
            for row, added_cost in zip(found, penalties.tolist(), strict=True):
                gx, gy, gz, risk = row[0], row[1], row[2], row[4]
                if not (
                    self.workspace.x[0] <= gx <= self.workspace.x[1]
                    and self.workspace.y[0] <= gy <= self.workspace.y[1]
                ):
                    continue
                target_yaw = nearest_equivalent_yaw(yaw, row[3], limits, math.pi)
                turn = abs(wrap_angle(target_yaw - yaw))
                distance = max(abs(gx - x), abs(gy - y))
                travel = max(
                    distance / limits.step_m, turn / limits.turn_rad if limits.turn_rad else 0
                )
                travel += max(z - gz, 0.0) / limits.step_m
                cost = travel + 12 * risk + added_cost
                if best is None or cost < best.cost:
                    best = TopDownGrasp(
                        body, (gx, gy, gz), target_yaw, risk=float(risk), cost=float(cost)
                    )
        return best

    def height_on_way(
        self,
        tool: YawPose,
        grasp: TopDownGrasp,
        limits: ActionLimits,
        heights: np.ndarray,
        clearance_m: float,
    ) -> float:
        """Return the least height of the tool after the next action on its way to a grasp.

        The open gripper moves towards the grasp along each axis, and turns, as fast as the limits
        allow. With the returned height, and at most one further step up in each later action, it
        stays above the height image.

        Args:
            heights: height image of `heights`.
            clearance_m: gap between the gripper and what is below it.
        """
        (x, y, z), yaw = tool
        gx, gy, gz = grasp.position
        turn = wrap_angle(grasp.yaw_rad - yaw)
        actions = max(abs(gx - x), abs(gy - y)) / limits.step_m
        if limits.turn_rad:
            actions = max(actions, abs(turn) / limits.turn_rad)
        least, corner = gz, np.array(self.corner)
        count = math.ceil(actions * SAMPLES_PER_ACTION)
        for t in np.linspace(0.0, actions, count + 1)[1:].tolist():
            move, rotation = t * limits.step_m, t * limits.turn_rad
            free = _free_height(
                x + min(max(gx - x, -move), move),
                y + min(max(gy - y, -move), move),
                yaw + min(max(turn, -rotation), rotation),
                heights,
                corner,
                self.gripper.half_width_m,
                self._jaws,
            )
            free = max(free + clearance_m, gz)
            # linear in the first action
            least = max(least, z + (free - z) / t if t < 1 else free - (t - 1) * limits.step_m)
        return least

    def risk_alone(self, samples: np.ndarray, tool: YawPose) -> float:
        """Return the least risk of a grasp, at the present yaw, of a body without obstacles.

        Args:
            samples: [N, 6] surface points and normals of the body.
        """
        center, yaws = samples[:, :3].mean(axis=0), np.array([tool[1]])
        found = self._grasps(samples, center, yaws, self._empty_image)
        return min(float(found[:, 4].min()), WORST_RISK) if len(found) else WORST_RISK

    def _grasps(
        self, samples: np.ndarray, center: np.ndarray, yaws: np.ndarray, heights: np.ndarray
    ) -> np.ndarray:
        """Return the result of `_search` for a body inside the workspace."""
        corner = np.array(self.corner)
        return _search(samples, center, yaws, heights, corner, *self.workspace.z, self._jaws)

    def placed_samples(self, body: Body) -> np.ndarray:
        """Return surface points and normals [N, 6] of a body at its present pose."""
        key = id(body.shape)
        if key not in self._samples:
            self._samples[key] = np.hstack(surface_samples(body.shape.mesh(), SAMPLES))
        local = self._samples[key]
        pose = body.pose
        return np.hstack([pose.apply(local[:, :3]), pose.rotate(local[:, 3:])])


class _Jaws(NamedTuple):
    """The outline of a gripper for compiled code, metres."""

    half_gap: float
    """Half the gap between the open fingers."""
    band_half: float
    """Half the width of the band that the fingers occupy."""
    palm: float
    """Height of the palm above the tool point."""
    depth: float
    """Extent of a fingertip along the direction in which it closes."""
    arc_u: np.ndarray
    arc_z: np.ndarray
    outline_u: np.ndarray
    outline_z: np.ndarray
    """In ascending order."""


# offsets of grasps from the centre of a body, across (v) and along (u) the closing direction
_OFFSETS_V = np.array([0.0, -0.012, 0.012, -0.024, 0.024])
_OFFSETS_U = np.array([0.0, -0.02, 0.02, -0.04, 0.04])


@njit()
def _height(heights, corner, x, y):  # noqa: ANN001, ANN202 -- compiled
    i = int((x - corner[0]) / PIXEL_M)
    j = int((y - corner[1]) / PIXEL_M)
    if i < 0 or j < 0 or i >= heights.shape[0] or j >= heights.shape[1]:
        return 1.0
    return heights[i, j]


@njit()
def _free_height(x, y, yaw, heights, corner, half_width, jaws):  # noqa: ANN001, ANN202
    """Return the height of the tool at which the open gripper touches the height image."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    free = -1.0
    for m in range(jaws.outline_u.shape[0]):
        for fu in (-jaws.outline_u[m], jaws.outline_u[m]):
            for w in (-half_width, 0.0, half_width):
                h = _height(heights, corner, x + cos * fu - sin * w, y + sin * fu + cos * w)
                free = max(free, h - jaws.outline_z[m])
    return free


@njit()
def _search(samples, center, yaws, heights, corner, low_z, high_z, jaws):  # noqa: ANN001, ANN202
    """Return the feasible grasps of one body, [N, 6]: x, y, z, yaw, risk, slip.

    Risk is a score of 0 for the best grasps. Slip is the logarithm of the odds, shifted to 0 or
    more, that the object rotates between the fingers and slips out; it is fitted to picks of random
    grasps of random shapes.
    """
    found = np.empty((yaws.shape[0] * _OFFSETS_V.shape[0] * _OFFSETS_U.shape[0], 6))
    count = 0
    n = samples.shape[0]
    u = np.empty(n)
    v = np.empty(n)
    is_between = np.empty(n, dtype=np.bool_)
    left_n, right_n = np.empty(4), np.empty(4)
    top, highest = samples[:, 2].max(), heights.max()
    half_gap, band_half = jaws.half_gap, jaws.band_half
    band = (-band_half, 0.0, band_half)
    for yaw in yaws:
        cos, sin = math.cos(yaw), math.sin(yaw)
        for k in range(n):
            dx, dy = samples[k, 0] - center[0], samples[k, 1] - center[1]
            u[k] = cos * dx + sin * dy
            v[k] = cos * dy - sin * dx
        for v0 in _OFFSETS_V:
            for u0 in _OFFSETS_U:
                # extent and height of the surface between the open fingers
                lowest_u, highest_u, peak = 1.0, -1.0, 0.0
                for k in range(n):
                    if abs(v[k] - v0) <= band_half and abs(u[k] - u0) < half_gap:
                        lowest_u, highest_u = min(lowest_u, u[k]), max(highest_u, u[k])
                        peak = max(peak, samples[k, 2])
                if highest_u < lowest_u or highest_u - lowest_u > 2 * (half_gap - LEAST_SIDE_GAP_M):
                    continue
                middle = (highest_u + lowest_u) / 2
                if u0 != 0.0 and abs(middle - u0) > 0.012:
                    continue  # another offset gives the same grasp
                x = center[0] + cos * middle - sin * v0
                y = center[1] + sin * middle + cos * v0
                half_width = (highest_u - lowest_u) / 2
                tip = np.interp(half_width, jaws.arc_u, jaws.arc_z)
                # the least height that floor, neighbours and palm allow
                z = max(low_z + 0.002, peak - min(jaws.palm - CLEARANCE_M, DEEPEST_M + tip))
                for m in range(jaws.outline_u.shape[0]):
                    low = jaws.outline_z[m]
                    if highest - low + CLEARANCE_M <= z or peak - (z + tip) < SHALLOWEST_M:
                        break
                    inside = jaws.outline_u[m] - jaws.depth
                    if inside <= half_gap <= jaws.outline_u[m]:  # tips descend as they close
                        last = np.interp(max(half_width, inside), jaws.arc_u, jaws.arc_z)
                        low = min(low, last)
                    for fu in (-jaws.outline_u[m], jaws.outline_u[m]):
                        for w in band:
                            h = _height(
                                heights, corner, x + cos * fu - sin * w, y + sin * fu + cos * w
                            )
                            z = max(z, h - low + CLEARANCE_M)
                depth = peak - (z + tip)
                if depth < SHALLOWEST_M or z > high_z:
                    continue
                covered = False
                for w in band:
                    for m in range(-2, 3):
                        fu = m * 0.015
                        h = _height(heights, corner, x + cos * fu - sin * w, y + sin * fu + cos * w)
                        covered = covered or h > peak + 0.01
                if covered:
                    continue
                # number of pixels that obstruct the closing fingers
                obstacles = 0
                edge = half_width + 0.006
                for m in range(3):
                    beside = edge + (half_gap - edge) * m / 3
                    end = z + np.interp(beside, jaws.arc_u, jaws.arc_z) + OBSTACLE_M
                    for fu in (-beside, beside):
                        for w in band:
                            h = _height(
                                heights, corner, x + cos * fu - sin * w, y + sin * fu + cos * w
                            )
                            obstacles += h > end
                # contact surfaces
                left, right = 1.0, -1.0
                for k in range(n):
                    is_between[k] = (
                        abs(v[k] - v0) <= band_half
                        and abs(u[k] - middle) < half_gap
                        and samples[k, 2] > z + tip
                    )
                    if is_between[k]:
                        left, right = min(left, u[k]), max(right, u[k])
                if right < left:
                    continue
                left_n[:] = 0.0
                right_n[:] = 0.0
                left_v0, left_v1, right_v0, right_v1 = 1.0, -1.0, 1.0, -1.0
                for k in range(n):
                    if is_between[k] and u[k] < left + CONTACT_DEPTH_M:
                        left_n[:3] += samples[k, 3:]
                        left_n[3] += 1.0
                        left_v0, left_v1 = min(left_v0, v[k]), max(left_v1, v[k])
                    if is_between[k] and u[k] > right - CONTACT_DEPTH_M:
                        right_n[:3] += samples[k, 3:]
                        right_n[3] += 1.0
                        right_v0, right_v1 = min(right_v0, v[k]), max(right_v1, v[k])
                left_n /= left_n[3]
                right_n /= right_n[3]
                opposition = -(
                    left_n[0] * right_n[0] + left_n[1] * right_n[1] + left_n[2] * right_n[2]
                )
                facing = min(
                    cos * right_n[0] + sin * right_n[1], -cos * left_n[0] - sin * left_n[1]
                )
                if opposition < LEAST_COSINE or facing < LEAST_COSINE:
                    continue
                risk = 2.5 * (1 - opposition) + 1.5 * max(0.0, 0.75 - facing)
                side_gap = half_gap - half_width
                risk += 0.4 * max(0.0, SIDE_GAP_M - side_gap) / SIDE_GAP_M
                risk += 0.1 * obstacles
                risk += 0.3 * max(0.0, 0.025 - depth) / 0.015
                risk += 6 * (abs(v0) + 0.5 * abs(middle))
                risk += 0.5 * max(0.0, top - peak) / 0.02
                found[count, 0], found[count, 1], found[count, 2] = x, y, z
                patch = min(left_v1 - left_v0, right_v1 - right_v0, PATCH_M)
                obliqueness = cos * (left_n[1] + right_n[1]) - sin * (left_n[0] + right_n[0])
                slip = 2.3 * (1 - patch / PATCH_M) + 3.4 * abs(obliqueness) + 60 * abs(v0)
                found[count, 3], found[count, 4], found[count, 5] = yaw, risk, slip
                count += 1
    return found[:count]
