"""EnvConfig: the keywords of `ba_torchrl.make`, typed and validated."""

from __future__ import annotations

import math
from functools import cache
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator
from typing_extensions import Self

from ba_torchrl.core.config import MAX_PIXELS, Interval, StrictModel, TaskParameters, numbers_of
from ba_torchrl.core.errors import ConfigError

Rgb = tuple[float, float, float]
CUSTOM_PHYSICS = ("time_step_s", "solver_iterations", "solver_residual")

_CLOSE_LOOP = {"control": "close_loop"}
_OPEN_LOOP = {"control": "open_loop"}


class EnvConfig(StrictModel):
    """The parameters of an environment (appendix B, table 4), under the paper's names.

    A value of ``None`` stands for the task's own default. Lengths are metres, angles radians.
    Fields marked "close loop" or "open loop" are refused by tasks of the other control. A task adds
    the fields of its own `TaskParameters`; see `env_config_model`.
    """

    robot: str = "kuka"
    """The robot arm."""
    action_sequence: str | None = None
    """One letter per action component. Close loop: p gripper, x y z displacement, r yaw; "pxyzr" by
    default. Open loop: p primitive, x y z position, up to three r; "pxyr" by default."""
    workspace: tuple[Interval, Interval, Interval] | None = None
    """Ranges of x, y and z."""
    object_scale_range: Interval | None = None
    """Scale of the objects, drawn per episode in steps of 0.02; a number means that scale."""
    max_steps: int | None = Field(default=None, ge=1, le=1_000_000)
    """Steps until the episode is truncated."""
    num_objects: int | None = Field(default=None, ge=1)
    """Number of objects, for tasks that allow several numbers."""
    obs_size: int = Field(default=128, ge=16, le=MAX_PIXELS)
    """Pixels along each side of the image."""
    in_hand_size: int | None = Field(default=None, ge=8, le=256, json_schema_extra=_OPEN_LOOP)
    """Open loop: pixels along each side of the in-hand image. By default 24, and 40 on bumps
    (appendix G.1)."""
    in_hand_mode: str | None = Field(default=None, json_schema_extra=_OPEN_LOOP)
    """Open loop: content of the in-hand image: "raw", "sub" or "proj"; see
    `ba_torchrl.sim.vision.in_hand`. By default "raw", and "proj" in six degrees of freedom."""
    top_down_approach: bool = Field(default=False, json_schema_extra=_OPEN_LOOP)
    """Open loop: approach vertically also with a tilted gripper."""
    fast_mode: bool = True
    """Teleport the arm, and a body that does not slip, along free paths; if False, all motion is
    simulated."""
    render: bool = False
    """Show the simulation in PyBullet's window."""
    random_orientation: bool = True
    """Objects start with random yaw."""
    half_rotation: bool | None = None
    """Keep the gripper's yaw within a half turn, which covers every two-finger grasp. Open loop:
    0 to pi, on by default. Close loop: -pi/2 to pi/2 about the start, off by default."""
    workspace_check: Literal["point", "bounding_box"] = "point"
    """Part of an object that must stay inside the workspace: its origin or its bounding box."""
    close_loop_tray: bool = Field(default=False, json_schema_extra=_CLOSE_LOOP)
    """Close loop: the objects lie in a tray as in Object Grasping."""
    view_type: str = Field(default="camera_center_xyz", json_schema_extra=_CLOSE_LOOP)
    """Close loop: view of the depth image; see `ba_torchrl.sim.vision.camera_views`."""
    view_scale: float = Field(default=1.5, gt=0, le=100, json_schema_extra=_CLOSE_LOOP)
    """Close loop: width of the image as a multiple of the workspace's width."""
    dpos: float = Field(default=0.05, gt=0, le=1, json_schema_extra=_CLOSE_LOOP)
    """Close loop: displacement along an axis at action 1."""
    drot: float = Field(default=math.pi / 4, gt=0, le=2 * math.pi, json_schema_extra=_CLOSE_LOOP)
    """Close loop: change of yaw at action 1."""
    obs_type: Literal["pixel", "vec"] = "pixel"
    """Observe an image, or the poses of gripper and objects as a vector."""
    rgb: bool = False
    """Add an RGB image of the scene, arm included, and its depth to every observation."""
    point_cloud: int = Field(default=0, ge=0, le=1_000_000)
    """Number of points of the scene's surfaces that are added to every observation."""
    observations: tuple[str, ...] = ()
    """Further observations by their registered names: "proprio", "joints", "wrist_rgb",
    "segmentation", "instruction"; see `ba_torchrl.envs.observations`."""
    camera_size: int | None = Field(default=None, ge=16, le=MAX_PIXELS)
    """Rows and columns of the cameras' images: `rgb`, "wrist_rgb", "segmentation". None stands for
    `obs_size`."""
    floor_color: Rgb | None = None
    """Colour of the floor in RGB images, components from 0 to 1; by default light, and a blue
    chequer in PyBullet's window and in `rgb`."""
    workspace_color: Rgb | None = None
    """Colour of the workspace's floor area in RGB images; None leaves it unmarked."""
    physics_mode: Literal["fast", "slow", "custom"] = "fast"
    """Settings of the physics engine: the fastest that hold grasps reliably, finer ones, or those
    of `time_step_s`, `solver_iterations` and `solver_residual`."""
    time_step_s: float | None = Field(default=None, ge=1e-4, le=1 / 60)
    """Custom physics: length of a physics step."""
    solver_iterations: int | None = Field(default=None, ge=1, le=10_000)
    """Custom physics: iterations of the contact solver in each step."""
    solver_residual: float | None = Field(default=None, ge=0)
    """Custom physics: residual at which the solver stops early; 0 for all iterations. As for the
    two fields above, None is the value of "fast", here 1e-5 in open loop and 0 in close loop."""
    reward: Literal["sparse", "dense", "difference"] = "sparse"
    """"sparse": 1 on success, else 0. "dense": on success 1, else the progress Phi of the task, in
    [0, 1), and success is truncated, not terminated. "difference": sparse, plus `reward_discount`
    Phi(s') - Phi(s), where Phi is 0 in a terminated state; optimal policies are those of the sparse
    reward (Ng et al., 1999)."""
    reward_discount: float = Field(default=0.99, gt=0, le=1)
    """Discount of the learner, for the reward "difference"."""
    expert: bool = False
    """Add the expert's action to every observation."""
    expert_chunk: int = Field(default=0, ge=0, le=100, json_schema_extra=_CLOSE_LOOP)
    """Close loop: number of the expert's next actions that are added to every observation. The
    expert plays them, and the state is restored bit for bit. Steps take that many times longer, and
    their last bits are those of an environment whose state is saved before each step."""
    seed: int | None = Field(default=None, ge=0)
    """Seed of all episodes; drawn at random if None."""

    @model_validator(mode="before")
    @classmethod
    def _without_numpy(cls, values: Any) -> Any:
        """Convert NumPy scalars and arrays to Python values."""
        if not isinstance(values, dict):
            return values
        return {
            name: value.tolist() if isinstance(value, np.generic | np.ndarray) else value
            for name, value in values.items()
        }

    @field_validator("workspace", mode="before")
    @classmethod
    def _as_pairs(cls, value: Any) -> Any:
        if value is None:
            return None
        what = "three (low, high) pairs of numbers for x, y and z"
        if not isinstance(value, list | tuple) or len(value) != 3:
            raise ValueError(f"must be {what}")
        return tuple(numbers_of(pair, what) for pair in value)

    @field_validator("object_scale_range", mode="before")
    @classmethod
    def _as_range(cls, value: Any) -> Any:
        if value is None:
            return None
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return numbers_of([value] * 2 if is_number else value, "a number or a (low, high) pair")

    @field_validator("floor_color", "workspace_color", mode="before")
    @classmethod
    def _as_color(cls, value: Any) -> Any:
        if value is None:
            return None
        what = "red, green and blue from 0 to 1"
        color = numbers_of(value, what, 3)
        if not all(0 <= x <= 1 for x in color):
            raise ValueError(f"must be {what}")
        return color

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.workspace is not None:
            for axis, (low, high) in zip("xyz", self.workspace, strict=True):
                if not (math.isfinite(low) and math.isfinite(high) and low < high):
                    raise ValueError(f"workspace: {axis} must be a range low < high")
        if self.object_scale_range is not None:
            low, high = self.object_scale_range
            if not 0 < low <= high < math.inf:
                raise ValueError("object_scale_range must satisfy 0 < low <= high")
        custom = [name for name in CUSTOM_PHYSICS if getattr(self, name) is not None]
        if custom and self.physics_mode != "custom":
            raise ValueError(f"{', '.join(custom)} needs physics_mode='custom'")
        if self.physics_mode == "custom" and not custom:
            raise ValueError(f"physics_mode='custom' needs one of {', '.join(CUSTOM_PHYSICS)}")
        usual = EnvConfig.model_fields["reward_discount"].default
        if self.reward != "difference" and self.reward_discount != usual:
            raise ValueError("reward_discount has no effect without reward='difference'")
        return self

    @property
    def camera_pixels(self) -> int:
        """Rows and columns of the cameras' images."""
        return self.camera_size or self.obs_size

    def check_control(self, task_id: str, control: str) -> None:
        """Raise `ConfigError` if a parameter of the other control differs from its default."""
        for name in sorted(EnvConfig.model_fields.keys() - self.fields_for(control)):
            if getattr(self, name) != EnvConfig.model_fields[name].default:
                kind = "close-loop" if control == "open_loop" else "open-loop"
                raise ConfigError(f"{name!r} is for {kind} tasks, which {task_id} is not")

    @classmethod
    def fields_for(cls, control: str) -> set[str]:
        """Return the names of the fields that apply to "open_loop" or "close_loop"."""
        return {
            name
            for name, field in cls.model_fields.items()
            if (field.json_schema_extra or {}).get("control", control) == control
        }


@cache
def env_config_model(parameters: type[TaskParameters]) -> type[EnvConfig]:
    """Return `EnvConfig` with the fields of a task's own parameters added.

    Raises:
        TypeError: the task declares a parameter of `EnvConfig` again.
    """
    if not parameters.model_fields:
        return EnvConfig
    if repeated := parameters.model_fields.keys() & EnvConfig.model_fields.keys():
        raise TypeError(
            f"{parameters.__qualname__} repeats parameters of every environment: "
            f"{', '.join(sorted(repeated))}"
        )
    return type(
        EnvConfig.__name__,
        (parameters, EnvConfig),
        {
            "__module__": __name__,
            "__reduce__": lambda self: (_restored, (parameters, self.__getstate__())),
        },
    )


def _restored(parameters: type[TaskParameters], state: dict[str, Any]) -> EnvConfig:
    """Return a configuration of `env_config_model` from its pickled state."""
    model = env_config_model(parameters)
    config = model.__new__(model)
    config.__setstate__(state)
    return config
