"""Views: the images that close-loop policies observe, registered by name.

Values are linear, in metres. Except in `camera_side_rgbd`, only the fingers of the robot are
visible: as squares in views from above, as boxes in views from the side. Image rows follow +x and
columns +y; views with an "r" in their axes rotate with the gripper.

| view | camera | value |
|---|---|---|
| `camera_center_xyz`, `_xyzr` | above the tool, follows its height | depth below camera |
| `camera_center_xyr`, `_xy` | above the tool, at a fixed height | z of the tool - height |
| `camera_center_z` | above the workspace centre, follows the tool's height | depth below camera |
| `camera_fix` | above the workspace centre, at a fixed height | z of the tool - height |
| `render_center` | points from two side cameras, projected from above | z of the tool - height |
| `pers_center_xyz` | `camera_center_xyz` with a field of view of 70 degrees | depth below camera |
| `camera_side` | opposite the robot, 0.6 m high, 40 degrees | depth along the optical axis |
| `camera_side_rgbd` | the same | red, green, blue from 0 to 1, and depth |

All but `pers_center_xyz` and `camera_side_rgbd` also exist with the suffix `_height`, with heights
above the floor as values. `view_scale` sets the width of the orthographic views.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.registry import Registry
from ba_torchrl.sim.geometry import Pose, YawPose, yaw_quaternion
from ba_torchrl.sim.shapes import Box
from ba_torchrl.sim.vision.camera import Camera, orthographic, perspective
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

MAX_RECESS_M = 0.02
"""Depth of the recesses that represent goal areas."""
FIXED_CAMERA_CLEARANCE_M = 0.04
"""Height of cameras at a fixed height above the top of the workspace; 0.29 m above the floor by
default."""


FINGER_SQUARE_HALF_M = 5 * 0.3 / 128
"""Half the edge of the square that represents a finger."""
FINGER_LENGTH_M = 0.1
"""Height of the box that represents a finger in oblique views."""


def finger_boxes(tool: YawPose, offset_m: float) -> SceneMesh:
    """Return the mesh of two boxes that represent the fingers.

    Their lower ends have the height of the tool, their axes the distance ``offset_m`` from it.
    """
    (x, y, z), yaw = tool
    box = Box(size_m=(2 * FINGER_SQUARE_HALF_M, 2 * FINGER_SQUARE_HALF_M, FINGER_LENGTH_M))
    return SceneMesh(
        PosedShape(
            box,
            Pose(
                (x + side * math.cos(yaw), y + side * math.sin(yaw), z + FINGER_LENGTH_M / 2),
                yaw_quaternion(yaw),
            ),
        )
        for side in (-offset_m, offset_m)
    )


def draw_fingers(
    image: np.ndarray,
    tool_px: tuple[float, float],
    offset_px: float,
    half_px: float,
    yaw_rad: float,
    value: float,
) -> None:
    """Paint the squares that represent the fingers into an image.

    Args:
        tool_px: row and column of the tool point.
        offset_px: distance between each square's centre and the tool point.
        yaw_rad: heading of the closing axis, from rows towards columns.
    """
    for side in (-offset_px, offset_px):
        center = (tool_px[0] + side * math.cos(yaw_rad), tool_px[1] + side * math.sin(yaw_rad))
        paint_square(image, center, half_px, yaw_rad, value)


@dataclass(frozen=True)
class ViewSetup:
    """Parameters that are the same for all images of an environment.

    Args:
        center_m: x and y of the workspace centre.
        z_m: lower and upper bound of z in the workspace.
        workspace_m: width of the workspace.
        width_m: width of the square that an orthographic image shows.
        camera_height_m: height above the tool of cameras that follow the tool.
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
    """The state of the scene from which an image is rendered."""

    setup: ViewSetup
    world: World
    camera: HeightCamera
    tool: YawPose
    opening: float

    @property
    def finger_offset_m(self) -> float:
        """Distance between the square of each finger and the tool point.

        The squares of closed fingers touch and do not overlap, so that they show the yaw of the
        tool.
        """
        return max(self.setup.finger_span_m * self.opening / 2, FINGER_SQUARE_HALF_M)


class View(ABC):
    """A method to render the scene."""

    channels: ClassVar[int] = 1
    rotates_with_scene: ClassVar[bool] = True
    """Whether the image of a scene that is rotated about z, with the tool, is rotated."""

    @abstractmethod
    def range_m(self, setup: ViewSetup) -> Range:
        """Return the lower and upper bound of the values of an image."""

    @abstractmethod
    def image(self, scene: ViewInput) -> np.ndarray:
        """Return the image, [C, H, W] float64."""

    def camera(self, scene: ViewInput) -> Camera:
        """Return the geometry of the last channel of the image."""
        raise ConfigError(f"{type(self).__name__} does not say where its camera is")


VIEWS: Registry[View] = Registry("view type", "ba_torchrl.sim", View)


@dataclass(frozen=True)
class TopDown(View):
    """An orthographic view from straight above.

    Args:
        follows_xy: centre the image at the tool instead of the workspace centre.
        follows_z: place the camera relative to the tool instead of at a fixed height. Surfaces
            above the camera appear at the height of the camera.
        follows_yaw: align the image rows with the x axis of the tool.
        shows_height: use heights above the floor as values instead of depths.
    """

    follows_xy: bool
    follows_z: bool
    follows_yaw: bool
    shows_height: bool

    @property
    def rotates_with_scene(self) -> bool:
        """False if the image rotates with the tool, which leaves it unchanged."""
        return not self.follows_yaw

    def range_m(self, setup: ViewSetup) -> Range:
        """Return the bounds of the depth below the camera or tool, or of the height."""
        low, high = setup.z_m
        if self.shows_height:
            top = high + setup.camera_height_m if self.follows_z else setup.fixed_camera_z_m
            return -MAX_RECESS_M, top
        if self.follows_z:
            return 0.0, high + setup.camera_height_m + MAX_RECESS_M
        return low - setup.fixed_camera_z_m, high + MAX_RECESS_M

    def image(self, scene: ViewInput) -> np.ndarray:
        setup, ((x, y, z), yaw) = scene.setup, scene.tool
        center = (x, y) if self.follows_xy else setup.center_m
        turn = yaw if self.follows_yaw else 0.0
        heights = scene.camera.heightmap(center, setup.width_m, setup.pixels, turn)
        camera_z = z + setup.camera_height_m if self.follows_z else setup.fixed_camera_z_m
        return self.to_values(scene, heights, center, turn, camera_z)

    def camera(self, scene: ViewInput) -> Camera:
        """Return the geometry; depths below the tool are as from a camera at its height."""
        setup, ((x, y, z), yaw) = scene.setup, scene.tool
        return orthographic(
            (
                *((x, y) if self.follows_xy else setup.center_m),
                z + setup.camera_height_m if self.follows_z else z,
            ),
            setup.width_m,
            setup.pixels,
            self.range_m(setup),
            "height" if self.shows_height else "depth",
            yaw if self.follows_yaw else 0.0,
        )

    def to_values(
        self,
        scene: ViewInput,
        heights: np.ndarray,
        center_m: tuple[float, float],
        turn_rad: float,
        camera_z_m: float,
    ) -> np.ndarray:
        """Convert heights [H, W] to the values [1, H, W] of the view and draw the fingers."""
        setup, ((x, y, z), yaw) = scene.setup, scene.tool
        low, high = self.range_m(setup)
        if self.shows_height:
            values = np.clip(heights, low, min(camera_z_m, high))
        elif self.follows_z:
            values = np.clip(camera_z_m - heights, low, high)
        else:
            values = np.clip(z - np.minimum(heights, camera_z_m), low, high)
        pixel = setup.width_m / setup.pixels
        dx, dy = x - center_m[0], y - center_m[1]  # both zero in views that rotate
        draw_fingers(
            values,
            (setup.pixels / 2 + dx / pixel, setup.pixels / 2 + dy / pixel),
            scene.finger_offset_m / pixel,
            FINGER_SQUARE_HALF_M / pixel,
            yaw - turn_rad,
            z if self.shows_height else 0.0,
        )
        return values[None]


@dataclass(frozen=True)
class PointSplat(View):
    """Points seen by two cameras at the sides of the workspace, projected from above the tool.

    Only points below the fingers are used, as the arm of a real robot would occlude others. Pixels
    without points take the value of the nearest pixel with points. Values are depths below the tool
    or heights above the floor.
    """

    shows_height: bool

    # 0.05 m, as in the reference implementation, is the height of a block: rounding errors would
    # decide whether its top is visible
    _min_ceiling_m: ClassVar[float] = 0.055
    _clearance_m: ClassVar[float] = 0.01
    _camera_pixels_per_pixel: ClassVar[int] = 2  # pixels of the cameras for each pixel of the image
    _max_pixels: ClassVar[int] = 1024

    def range_m(self, setup: ViewSetup) -> Range:
        """Return the bounds of the depth below the tool, or of the height."""
        return self._top_down.range_m(setup)

    def image(self, scene: ViewInput) -> np.ndarray:
        setup, ((x, y, z), _) = scene.setup, scene.tool
        ceiling = max(z - self._clearance_m, self._min_ceiling_m)
        # the image is visible for every position of the tool in the workspace
        lenses = side_lenses(setup.center_m, setup.workspace_m + setup.width_m)
        everywhere = (-math.inf, math.inf)
        points = visible_points(
            [scene.camera.mesh],
            lenses,
            min(self._camera_pixels_per_pixel * setup.pixels, self._max_pixels),
            (everywhere, everywhere, (-math.inf, ceiling)),
        )
        heights = splat_heightmap(points, (x, y), setup.width_m, setup.pixels)
        return self._top_down.to_values(scene, heights, (x, y), 0.0, ceiling)

    def camera(self, scene: ViewInput) -> Camera:
        return self._top_down.camera(scene)

    @property
    def _top_down(self) -> TopDown:
        return TopDown(
            follows_xy=True, follows_z=False, follows_yaw=False, shows_height=self.shows_height
        )


@dataclass(frozen=True)
class PerspectiveTopDown(View):
    """A perspective camera above the tool that looks straight down.

    The values are depths along the optical axis, so that the floor has a constant value. The
    fingers are drawn at the projections of their tips.
    """

    fov_rad: float

    def range_m(self, setup: ViewSetup) -> Range:
        """Return the bounds of the depth below the camera."""
        return 0.0, setup.z_m[1] + setup.camera_height_m + MAX_RECESS_M

    def image(self, scene: ViewInput) -> np.ndarray:
        setup, (_, yaw) = scene.setup, scene.tool
        lens = self._lens(scene)
        depth = depth_image([scene.camera.mesh], lens, setup.pixels)
        values = np.clip(depth, *self.range_m(setup))
        scale = lens.focal_px(setup.pixels) / setup.camera_height_m
        draw_fingers(
            values,
            (setup.pixels / 2, setup.pixels / 2),
            scene.finger_offset_m * scale,
            FINGER_SQUARE_HALF_M * scale,
            yaw,
            0.0,
        )
        return values[None]

    def camera(self, scene: ViewInput) -> Camera:
        setup = scene.setup
        return perspective(self._lens(scene), setup.pixels, self.range_m(setup))

    def _lens(self, scene: ViewInput) -> Lens:
        (x, y, z), _ = scene.tool
        return Lens((x, y, z + scene.setup.camera_height_m), (x, y, z), self.fov_rad)


@dataclass(frozen=True)
class Oblique(View):
    """A perspective camera opposite the robot that looks at the workspace centre.

    Values are depths along the optical axis or heights above the floor.
    """

    shows_height: bool

    rotates_with_scene: ClassVar[bool] = False

    def range_m(self, setup: ViewSetup) -> Range:
        """Return the bounds of the depth in the workspace, or of the height."""
        if self.shows_height:
            return -MAX_RECESS_M, setup.fixed_camera_z_m
        lens = oblique_lens(setup.center_m)
        nearest, _ = lens.plane_depth_range_m(setup.fixed_camera_z_m)
        return nearest, lens.plane_depth_range_m(-MAX_RECESS_M)[1]

    def image(self, scene: ViewInput) -> np.ndarray:
        setup = scene.setup
        lens = oblique_lens(setup.center_m)
        fingers = finger_boxes(scene.tool, scene.finger_offset_m)
        values = depth_image([scene.camera.mesh, fingers], lens, setup.pixels)
        if self.shows_height:
            values = lens.heights_m(values)
        return np.clip(values, *self.range_m(setup))[None]

    def camera(self, scene: ViewInput) -> Camera:
        setup, values = scene.setup, "height" if self.shows_height else "depth"
        lens = oblique_lens(setup.center_m)
        return perspective(lens, setup.pixels, self.range_m(setup), values)


@dataclass(frozen=True)
class ObliqueRgbd(View):
    """Colour and depth of the oblique view, with the robot."""

    channels: ClassVar[int] = 4
    rotates_with_scene: ClassVar[bool] = False

    def range_m(self, setup: ViewSetup) -> Range:
        """Return the bounds of colours (0 to 1) and depths together."""
        return 0.0, max(1.0, Oblique(shows_height=False).range_m(setup)[1])

    def image(self, scene: ViewInput) -> np.ndarray:
        """Return red, green, blue and depth, [4, H, W]."""
        setup = scene.setup
        rgb, depth = render_rgbd(scene.world, oblique_lens(setup.center_m), setup.pixels)
        depth = np.clip(depth, *self.range_m(setup))
        return np.concatenate([np.moveaxis(rgb / 255.0, -1, 0), depth[None]])

    def camera(self, scene: ViewInput) -> Camera:
        setup = scene.setup
        return perspective(oblique_lens(setup.center_m), setup.pixels, self.range_m(setup))


def _register(name: str, kind: type[View], **options: bool) -> None:
    """Register a view, and its variant with heights as values under the suffix `_height`."""
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
