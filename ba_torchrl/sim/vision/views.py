"""Views: what a close-loop policy sees of the scene, by name.

Values are metres and linear. Of the robot only the fingers appear: as squares in the views from
above, as two posts in those from the side; `camera_side_rgbd` alone shows the arm. Rows follow +x
and columns +y, turned with the gripper in the views whose name has an "r".

| view | seen from | value |
|---|---|---|
| `camera_center_xyz`, `_xyzr` | straight above the tool, hanging over it | depth below camera |
| `camera_center_xyr`, `_xy` | straight above the tool, at a fixed height | tool's z - height |
| `camera_center_z` | above the workspace's centre, hanging over the tool | depth below camera |
| `camera_fix` | above the workspace's centre, at a fixed height | tool's z - height |
| `render_center` | the points that two cameras on the sides see, from above | tool's z - height |
| `pers_center_xyz` | `camera_center_xyz` with a perspective of 70 degrees | depth below camera |
| `camera_side` | opposite the robot, 0.6 m up, 40 degrees | depth along the optical axis |
| `camera_side_rgbd` | the same | red, green, blue from 0 to 1, and depth |

Those from above and `camera_side` exist with the suffix `_height`: height above the floor of what
each pixel shows. `view_scale` sets the width of the views without perspective.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ba_torchrl.registry import Registry
from ba_torchrl.sim.geometry import YawPose, yaw_quaternion
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.depth import (
    HeightCamera,
    PosedShape,
    SceneMesh,
    depth_image,
    splat_heightmap,
    visible_points,
)
from ba_torchrl.sim.vision.kernels import paint_square
from ba_torchrl.sim.vision.lens import Lens, Range, oblique_lens, side_lenses
from ba_torchrl.sim.vision.rgb import render_rgbd
from ba_torchrl.sim.world import World

VIEWS: Registry[View] = Registry("view type", "ba_torchrl.sim")

FINGER_SQUARE_HALF_M = 5 * 0.3 / 128
"""Half the edge of the square that stands for a finger."""
FINGER_LENGTH_M = 0.1
"""Height of the post that stands for a finger in oblique views."""
MAX_RECESS_M = 0.02
"""Goal areas appear as dips of this depth."""
FIXED_CAMERA_CLEARANCE_M = 0.04
"""Cameras at a fixed height hang this far above the workspace: 0.29 m by default."""


@dataclass(frozen=True)
class ViewSetup:
    """What stays the same from image to image.

    Args:
        center_m: x and y of the workspace's centre.
        z_m: the workspace's range of z.
        workspace_m: the workspace's width.
        width_m: width of an image without perspective.
        pixels: number of rows and columns.
        camera_height_m: cameras that follow the tool hang this far above it.
        finger_span_m: distance between the squares of the fully open fingers.
    """

    center_m: tuple[float, float]
    z_m: Range
    workspace_m: float
    width_m: float
    pixels: int
    camera_height_m: float
    finger_span_m: float

    @property
    def fixed_camera_z_m(self) -> float:
        """Height of the cameras that do not follow the tool."""
        return self.z_m[1] + FIXED_CAMERA_CLEARANCE_M


@dataclass(frozen=True)
class ViewInput:
    """What an image is made from.

    Args:
        setup: what stays the same.
        world: for pictures in colour.
        camera: knows the bodies of the scene.
        tool: position and yaw of the tool point.
        opening: how far the gripper is open, 0 to 1.
    """

    setup: ViewSetup
    world: World
    camera: HeightCamera
    tool: YawPose
    opening: float

    @property
    def finger_offset_m(self) -> float:
        """Distance of each finger's square from the tool point."""
        return self.setup.finger_span_m * self.opening / 2


class View(ABC):
    """A way to look at the scene."""

    channels: ClassVar[int] = 1

    @abstractmethod
    def range_m(self, setup: ViewSetup) -> Range:
        """Return the least and the greatest value of an image."""

    @abstractmethod
    def image(self, seen: ViewInput) -> np.ndarray:
        """Return the image, [C, H, W] float64."""


@dataclass(frozen=True)
class TopDown(View):
    """Orthographic, from straight above.

    Args:
        follows_xy: the image's centre is the tool's, else the workspace's.
        follows_z: the camera hangs above the tool, else at a fixed height. What is higher than
            the camera is cut off.
        turns: the rows run along the line on which the fingers open.
        shows_height: the values are heights above the floor, else depths.
    """

    follows_xy: bool
    follows_z: bool
    follows_yaw: bool
    shows_height: bool

    def range_m(self, setup: ViewSetup) -> Range:
        """Return the range of depth below camera, of depth below the tool, or of height."""
        low, high = setup.z_m
        if self.shows_height:
            top = high + setup.camera_height_m if self.follows_z else setup.fixed_camera_z_m
            return -MAX_RECESS_M, top
        if self.follows_z:
            return 0.0, high + setup.camera_height_m + MAX_RECESS_M
        return low - setup.fixed_camera_z_m, high + MAX_RECESS_M

    def image(self, seen: ViewInput) -> np.ndarray:
        """Return the image, [1, H, W]."""
        setup, ((x, y, z), yaw) = seen.setup, seen.tool
        center = (x, y) if self.follows_xy else setup.center_m
        turn = yaw if self.follows_yaw else 0.0
        heights = seen.camera.heightmap(center, setup.width_m, setup.pixels, turn)
        camera_z = z + setup.camera_height_m if self.follows_z else setup.fixed_camera_z_m
        return self.to_values(seen, heights, center, turn, camera_z)

    def to_values(
        self,
        seen: ViewInput,
        heights: np.ndarray,
        center_m: tuple[float, float],
        turn_rad: float,
        camera_z_m: float,
    ) -> np.ndarray:
        """Turn heights into values and draw the fingers.

        Args:
            seen: the scene.
            heights: [H, W] metres.
            center_m: x and y of the image's centre.
            turn_rad: turn of the image.
            camera_z_m: height of the camera.

        Returns:
            [1, H, W] metres.
        """
        setup, ((x, y, z), yaw) = seen.setup, seen.tool
        low, high = self.range_m(setup)
        if self.shows_height:
            values = np.clip(heights, low, min(camera_z_m, high))
        elif self.follows_z:
            values = np.clip(camera_z_m - heights, low, high)
        else:
            values = np.clip(z - np.minimum(heights, camera_z_m), low, high)
        pixel = setup.width_m / setup.pixels
        dx, dy = x - center_m[0], y - center_m[1]  # both zero where the image turns
        _draw_fingers(
            values,
            (setup.pixels / 2 + dx / pixel, setup.pixels / 2 + dy / pixel),
            seen.finger_offset_m / pixel,
            FINGER_SQUARE_HALF_M / pixel,
            yaw - turn_rad,
            z if self.shows_height else 0.0,
        )
        return values[None]


@dataclass(frozen=True)
class PointSplat(View):
    """Points that two cameras beside the workspace see, looked at from straight above the tool.

    Only points below the fingers count, or the arm of a real robot would hide the scene; what
    neither camera sees takes the nearest pixel's height.

    Args:
        shows_height: the values are heights above the floor, else depths below the tool.
    """

    shows_height: bool

    # the reference's 5 cm are a block's height: a hair decided whether its top was seen
    _min_ceiling_m: ClassVar[float] = 0.055
    _clearance_m: ClassVar[float] = 0.01
    _camera_pixels_per_pixel: ClassVar[int] = 2  # pixels of the cameras for each pixel of the image
    _max_pixels: ClassVar[int] = 1024

    def range_m(self, setup: ViewSetup) -> Range:
        """Return the range of depth below the tool, or of height."""
        return self._top_down.range_m(setup)

    def image(self, seen: ViewInput) -> np.ndarray:
        """Return the image, [1, H, W]."""
        setup, ((x, y, z), _) = seen.setup, seen.tool
        ceiling = max(z - self._clearance_m, self._min_ceiling_m)
        # wherever in the workspace the tool is, the image lies in sight
        lenses = side_lenses(setup.center_m, setup.workspace_m + setup.width_m)
        everywhere = (-math.inf, math.inf)
        points = visible_points(
            [seen.camera.mesh],
            lenses,
            min(self._camera_pixels_per_pixel * setup.pixels, self._max_pixels),
            (everywhere, everywhere, (-math.inf, ceiling)),
        )
        heights = splat_heightmap(points, (x, y), setup.width_m, setup.pixels)
        return self._top_down.to_values(seen, heights, (x, y), 0.0, ceiling)

    @property
    def _top_down(self) -> TopDown:
        return TopDown(
            follows_xy=True, follows_z=False, follows_yaw=False, shows_height=self.shows_height
        )


@dataclass(frozen=True)
class PerspectiveTopDown(View):
    """A perspective camera that hangs above the tool and looks straight down.

    The values are depths below the camera, the same for all of the floor. The fingers are drawn
    where the camera sees their tips.
    """

    fov_rad: float

    def range_m(self, setup: ViewSetup) -> Range:
        """Return the range of depth below the camera."""
        return 0.0, setup.z_m[1] + setup.camera_height_m + MAX_RECESS_M

    def image(self, seen: ViewInput) -> np.ndarray:
        """Return the image, [1, H, W]."""
        setup, ((x, y, z), yaw) = seen.setup, seen.tool
        lens = Lens((x, y, z + setup.camera_height_m), (x, y, z), self.fov_rad)
        depth = depth_image([seen.camera.mesh], lens, setup.pixels)
        values = np.clip(depth, *self.range_m(setup))
        scale = lens.focal_px(setup.pixels) / setup.camera_height_m
        _draw_fingers(
            values,
            (setup.pixels / 2, setup.pixels / 2),
            seen.finger_offset_m * scale,
            FINGER_SQUARE_HALF_M * scale,
            yaw,
            0.0,
        )
        return values[None]


@dataclass(frozen=True)
class Oblique(View):
    """A perspective camera opposite the robot that looks at the workspace's centre.

    Args:
        shows_height: the values are heights above the floor, else depths along the optical axis.
    """

    shows_height: bool

    def range_m(self, setup: ViewSetup) -> Range:
        """Return the range of depth from the workspace's ceiling to the floor, or of height."""
        if self.shows_height:
            return -MAX_RECESS_M, setup.fixed_camera_z_m
        lens = oblique_lens(setup.center_m)
        return lens.plane_depth_range_m(setup.fixed_camera_z_m)[0], lens.plane_depth_range_m(
            -MAX_RECESS_M
        )[1]

    def image(self, seen: ViewInput) -> np.ndarray:
        """Return the image, [1, H, W]."""
        setup = seen.setup
        lens = oblique_lens(setup.center_m)
        fingers = finger_boxes(seen.tool, seen.finger_offset_m)
        values = depth_image([seen.camera.mesh, fingers], lens, setup.pixels)
        if self.shows_height:
            values = lens.heights_m(values)
        return np.clip(values, *self.range_m(setup))[None]


@dataclass(frozen=True)
class ObliqueRgbd(View):
    """The oblique view in colour and depth, arm included."""

    channels: ClassVar[int] = 4

    def range_m(self, setup: ViewSetup) -> Range:
        """Return 0 and the depth of the farthest floor; colours lie between 0 and 1."""
        return 0.0, max(1.0, Oblique(shows_height=False).range_m(setup)[1])

    def image(self, seen: ViewInput) -> np.ndarray:
        """Return red, green, blue and depth, [4, H, W]."""
        setup = seen.setup
        rgb, depth = render_rgbd(seen.world, oblique_lens(setup.center_m), setup.pixels)
        depth = np.clip(depth, *self.range_m(setup))
        return np.concatenate([np.moveaxis(rgb / 255.0, -1, 0), depth[None]])


def finger_boxes(tool: YawPose, offset_m: float) -> SceneMesh:
    """Return two upright posts that stand for the fingers.

    Args:
        tool: position and yaw of the tool point, at the height of the posts' lower ends.
        offset_m: distance of each post's axis from the tool point.
    """
    (x, y, z), yaw = tool
    post = Box(size_m=(2 * FINGER_SQUARE_HALF_M, 2 * FINGER_SQUARE_HALF_M, FINGER_LENGTH_M))
    return SceneMesh(
        PosedShape(
            post,
            (
                (x + side * math.cos(yaw), y + side * math.sin(yaw), z + FINGER_LENGTH_M / 2),
                yaw_quaternion(yaw),
            ),
        )
        for side in (-offset_m, offset_m)
    )


def _draw_fingers(
    image: np.ndarray,
    tool_px: tuple[float, float],
    offset_px: float,
    half_px: float,
    yaw_rad: float,
    value: float,
) -> None:
    """Write two squares on either side of the tool into an image."""
    for side in (-offset_px, offset_px):
        center = (tool_px[0] + side * math.cos(yaw_rad), tool_px[1] + side * math.sin(yaw_rad))
        paint_square(image, center, half_px, yaw_rad, value)


def _register(name: str, kind: type[View], **options: bool) -> None:
    """File a view under its name, and its heights under the name with a suffix."""
    VIEWS.register(name)(kind(**options, shows_height=False))
    VIEWS.register(f"{name}_height")(kind(**options, shows_height=True))


for _axes in ("xyz", "xyzr", "xyr", "xy", "z"):
    _register(
        f"camera_center_{_axes}",
        TopDown,
        follows_xy="x" in _axes,
        follows_z="z" in _axes,
        follows_yaw="r" in _axes,
    )
_register("camera_fix", TopDown, follows_xy=False, follows_z=False, follows_yaw=False)
_register("render_center", PointSplat)
_register("camera_side", Oblique)
VIEWS.register("camera_side_rgbd")(ObliqueRgbd())
VIEWS.register("pers_center_xyz")(PerspectiveTopDown(math.radians(70)))
