"""Open-loop control: every action is a complete pick or place, chosen on a heightmap."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from torchrl.data import Bounded

from ba_torchrl.core import keys
from ba_torchrl.core.actions import PICK, PLACE, PickPlaceCommand
from ba_torchrl.core.images import ImageSpec
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.episode_positions import RecordedPosition
from ba_torchrl.envs.episodes import SETTLE_STEPS
from ba_torchrl.envs.rendering import ARM_VIEW, DISPLAY_POINT, DISPLAY_YAW_RAD, ArmDisplay
from ba_torchrl.envs.scene import Scene
from ba_torchrl.envs.settings import ResolvedEnv
from ba_torchrl.sim.control.pick_place import PickPlace, PickPlaceLimits
from ba_torchrl.sim.geometry import downward, tool_rotation
from ba_torchrl.sim.robots.base import Robot
from ba_torchrl.sim.vision.camera import Camera, orthographic
from ba_torchrl.sim.vision.in_hand import IN_HAND_MODES, PickView
from ba_torchrl.sim.world import Physics, World
from ba_torchrl.tasks.base import Task
from ba_torchrl.tasks.workspace import ActionLimits

HOME_TOLERANCE_RAD = 1e-6


class OpenLoopEnv(RecordedPosition, BulletArmEnv):
    """A task under open-loop control (paper section 3.2, appendix A.1, G.1).

    An action is a pose and a primitive. A pick with an object in the gripper and a place without
    one have no effect but count as steps. The same holds for poses out of reach: those without
    inverse kinematics, and those at which hand or arm would penetrate the ground. Without the z
    component, the height is computed from the heightmap around the target. Without the primitive,
    an empty gripper picks and a gripper that holds an object places. The image is the heightmap of
    the workspace, without the arm and the held object.
    """

    hand_point = DISPLAY_POINT._replace(height_m=0.23)
    video_caption = "arm motion between poses: interpolated"
    # a stack of four creeps by 0.15 mm in two seconds; without a residual, by 0.11 mm
    physics = Physics(time_step_s=1 / 240, solver_iterations=30, solver_residual=1e-5)

    def __init__(self, resolved: ResolvedEnv) -> None:
        self._in_hand_kind = IN_HAND_MODES[resolved.config.in_hand_mode]()
        self._display = ArmDisplay(partial(self._build_scene, window=False))
        super().__init__(resolved)

    @property
    def action_limits(self) -> ActionLimits:
        """Displacement and rotations of one action: unlimited, or none for an angle it lacks."""
        components = set(self.actions.components)
        return ActionLimits(
            math.inf,
            math.pi if "rz" in components else 0.0,
            can_tilt={"ry", "rx"} <= components,
        )

    @property
    def pixel_m(self) -> float:
        """Width of a pixel, metres."""
        return self.workspace.width / self.config.obs_size

    # -- for the base class ------------------------------------------------------------------

    def _make_controller(self, robot: Robot, task: Task) -> PickPlace:
        controller = PickPlace(
            robot,
            task.terrain,
            teleport=self.config.fast_mode,
            opening=task.finger_opening,
            top_down=self.config.top_down_approach,
        )
        controller.on_contact = self._call_on_contact
        return controller

    @property
    def _required_tool_heights(self) -> tuple[float, ...]:
        floor = self.workspace.z[0]
        return floor + 0.01, floor + PickPlaceLimits().approach_distance_m + 0.01

    def _make_action_spec(self) -> Bounded:
        low, high = torch.from_numpy(np.array(self.actions.ranges, dtype=np.float32).T)
        return Bounded(low, high, (self.actions.size,), device="cpu", dtype=torch.float32)

    def _declare_images(self) -> dict[str, ImageSpec]:
        highest_m, patch = self.workspace.z[1], self.config.in_hand_size
        if self._in_hand_kind.channels == 1:
            in_hand = ImageSpec(1, patch, highest_m, frame="gripper")
        else:  # projections: numbers of voxels
            in_hand = ImageSpec(3, patch, patch, frame="gripper", channel_axes=("yz", "xz", "xy"))
        return {
            keys.HEIGHTMAP: ImageSpec(1, self.config.obs_size, highest_m),
            keys.IN_HAND: in_hand,
        }

    def _place_robot(self, scene: Scene) -> None:
        held = scene.controller.held
        scene.controller.reset()
        if held is not None and held.is_inactive:
            held.is_hidden = True  # the task has deactivated it
        self._memory = {}

    def _act(self, scene: Scene, action: np.ndarray) -> None:
        command = self.actions.decode(action)
        controller = scene.controller
        controller.is_out_of_reach = False
        holding = controller.held is not None
        primitive = command.primitive
        if primitive is None:
            primitive = PLACE if holding else PICK
        if primitive == PICK and not holding:
            before = self._heightmap(scene)
            position = self._position(scene, command, primitive, before)
            body = controller.pick(position, tool_rotation(*command.angles_rad))
            scene.world.settle(max_steps=SETTLE_STEPS)
            if body is not None:
                after = self._heightmap(scene)
                self._memory = {"in_hand": self._draw_in_hand(before, after, position, command)}
        elif primitive == PLACE and holding:
            position = self._position(scene, command, primitive)
            controller.place(position, tool_rotation(*command.angles_rad))
            scene.world.settle(max_steps=SETTLE_STEPS)
        controller.update_grasp()
        if controller.held is None:
            self._memory = {}

    def _images(self, scene: Scene) -> dict[str, np.ndarray]:
        size = self.config.in_hand_size
        empty = np.zeros((self._in_hand_kind.channels, size, size))
        heights = np.clip(self._heightmap(scene), 0.0, self.workspace.z[1])
        return {keys.HEIGHTMAP: heights[None], keys.IN_HAND: self._memory.get("in_hand", empty)}

    def _cameras(self, scene: Scene) -> dict[str, Camera]:
        space = self.workspace
        center, range_m = (*space.center, space.z[1]), (0.0, space.z[1])
        size = self.config.obs_size
        return {keys.HEIGHTMAP: orthographic(center, space.width, size, range_m, "height")}

    def _is_holding(self, scene: Scene) -> bool:
        return scene.controller.held is not None

    def _expert_action(self, scene: Scene) -> np.ndarray:
        return self.actions.encode(scene.task.expert_command())

    def _expert_specs(self, action: Bounded) -> dict[str, Bounded]:
        """Return the specifications of the expert's action and, if it gives some, equal moves."""
        specs = super()._expert_specs(action)
        if count := self.task_class.equal_moves:
            specs[keys.EXPERT_MOVES] = action.expand(count, self.actions.size).clone()
        return specs

    def _expert_entries(self, scene: Scene) -> dict[str, np.ndarray]:
        """Return the expert's action and, if it gives some, the moves that are as good."""
        count = self.task_class.equal_moves
        if not count:
            return super()._expert_entries(scene)
        moves = [self.actions.encode(move) for move in scene.task.expert_moves()[:count]]
        moves += moves[:1] * (count - len(moves))
        return {keys.EXPERT_ACTION: moves[0].copy(), keys.EXPERT_MOVES: np.stack(moves)}

    def _rendered_world(self, scene: Scene) -> World:
        """Return the world of a scene; between actions, one with the arm above the workspace."""
        if math.dist(scene.robot.joints, scene.robot.home_joints) > HOME_TOLERANCE_RAD:
            return scene.world
        position = DISPLAY_POINT.above(scene.task.terrain)
        return self._display.posed(
            scene, self._episodes.scale(), position, downward(DISPLAY_YAW_RAD)
        )

    def video_images(
        self, width: int, height: int, *, at_contact: bool = False
    ) -> Iterator[np.ndarray]:
        """Yield the images of a video, which show the whole arm; see `BulletArmEnv`.

        The simulation teleports the arm. These images show it move, by interpolation of its joints,
        to the grasp or the release of the action and back.
        """
        scene, display = self.scene, self._display
        if at_contact:
            motion = display.approach(scene.robot.joints, top_down=self.config.top_down_approach)
            last = scene.world
        else:
            last, motion = self._rendered_world(scene), display.retreat()
        arm_m = display.extent_m()
        for world in itertools.chain(motion, [last]):
            yield self._draw(world, arm_m, width, height, ARM_VIEW)

    def close(self, *, raise_if_closed: bool = True) -> None:
        self._display.close()
        super().close(raise_if_closed=raise_if_closed)

    # ----------------------------------------------------------------------------------------

    def _call_on_contact(self) -> None:
        if self.on_contact is not None:
            self.on_contact()

    def _heightmap(self, scene: Scene) -> np.ndarray:
        return scene.camera.heightmap(
            self.workspace.center, self.workspace.width, self.config.obs_size
        )

    def _pixel_of(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the row and column of a point; pixel (i, j) has its centre at i + 1/2, j + 1/2."""
        return (
            (x_m - self.workspace.x[0]) / self.pixel_m,
            (y_m - self.workspace.y[0]) / self.pixel_m,
        )

    def _position(
        self,
        scene: Scene,
        command: PickPlaceCommand,
        primitive: int,
        heights: np.ndarray | None = None,
    ) -> tuple[float, float, float]:
        """Return the target of the tool; the heightmap gives its height if the action has no z.

        Args:
            heights: the heightmap; None means that it is rendered if it is needed.
        """
        if command.z_m is not None:
            return command.x_m, command.y_m, command.z_m
        if heights is None:
            heights = self._heightmap(scene)
        task, xy = scene.task, (command.x_m, command.y_m)
        half = task.window_m(scene.controller.held) / self.pixel_m
        rows, columns = (
            slice(max(math.ceil(c - half - 0.5), 0), max(math.floor(c + half + 0.5), 1))
            for c in self._pixel_of(command.x_m, command.y_m)
        )
        window = heights[rows, columns]
        top = float(window.max()) if window.size else task.terrain.height_m(xy)
        height = task.pick_height_m(top, xy) if primitive == PICK else task.place_height_m(top, xy)
        return *xy, min(height, self.workspace.z[1])

    def _draw_in_hand(
        self,
        before: np.ndarray,
        after: np.ndarray,
        position: tuple[float, float, float],
        command: PickPlaceCommand,
    ) -> np.ndarray:
        view = PickView(
            before,
            after,
            self._pixel_of(position[0], position[1]),
            self.pixel_m,
            position[2],
            *command.angles_rad,
        )
        return self._in_hand_kind.draw(view, self.config.in_hand_size)
