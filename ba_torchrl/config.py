"""EnvConfig: what `ba_torchrl.make` accepts, typed and validated."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from typing import Any, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

Interval = tuple[float, float]


class ConfigError(ValueError):
    """A configuration that cannot be used; the message says what is allowed."""


def explain(error: ValidationError, known: Iterable[str], what: str) -> ConfigError:
    """Turn pydantic's report into a `ConfigError` that names the way out."""
    known = sorted(known)
    lines = []
    for item in error.errors():
        field = ".".join(str(part) for part in item["loc"]) or "configuration"
        if item["type"] == "extra_forbidden":
            close = difflib.get_close_matches(field.split(".")[-1], known, n=1)
            hint = f" Did you mean {close[0]!r}?" if close else ""
            lines.append(f"unknown parameter {field!r}.{hint} Known: {', '.join(known)}")
        else:
            message = item["msg"].removeprefix("Value error, ")
            lines.append(f"{field}: {message} (got {item['input']!r})")
    return ConfigError(f"invalid {what}:\n  " + "\n  ".join(lines))


Model = TypeVar("Model", bound=BaseModel)


def parse(model: type[Model], values: dict[str, Any], what: str) -> Model:
    """Validate ``values`` as a ``model``.

    Args:
        model: a pydantic model.
        values: field names and their values.
        what: what is being configured, for the error message.

    Raises:
        ConfigError: a name is unknown, a type wrong or a value out of range.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise explain(error, model.model_fields, what) from None


class StrictModel(BaseModel):
    """Immutable settings that refuse unknown names and wrong types."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class EnvConfig(StrictModel):
    """The parameters of an environment (appendix B, table 4), under the paper's names.

    A value of ``None`` stands for the task's own default. Lengths are metres, angles radians.
    """

    robot: str = "kuka"
    """The robot arm."""
    action_sequence: str = "pxyzr"
    """One letter per action component: p gripper, x y z displacement, r yaw."""
    workspace: tuple[Interval, Interval, Interval] | None = None
    """Ranges of x, y and z."""
    object_scale_range: Interval | None = None
    """Scale of the objects, drawn per episode in steps of 0.02; a number means that scale."""
    max_steps: int | None = Field(default=None, ge=1)
    """Steps until the episode is truncated."""
    obs_size: int = Field(default=128, ge=16, le=1024)
    """Pixels along each side of the image."""
    fast_mode: bool = True
    """Teleport the arm where it touches nothing; off, every centimetre is simulated."""
    random_orientation: bool = True
    """Objects start with random yaw."""
    workspace_check: Literal["point", "bounding_box"] = "point"
    """What of an object must stay inside the workspace: its origin, or its whole outline."""
    view_scale: float = Field(default=1.5, gt=0)
    """Width of the close-loop image as a multiple of the workspace's width."""
    dpos: float = Field(default=0.05, gt=0)
    """Close loop: displacement along an axis at action 1."""
    drot: float = Field(default=math.pi / 4, gt=0)
    """Close loop: change of yaw at action 1."""
    expert: bool = False
    """Add what the expert would do to every observation."""
    seed: int | None = Field(default=None, ge=0)
    """Seed of the first episode and all that follow it; drawn at random if None."""

    @field_validator("workspace", mode="before")
    @classmethod
    def _as_pairs(cls, value: Any) -> Any:
        if value is None:
            return None
        try:  # lists and arrays, as configuration files and the paper write them
            return tuple(tuple(float(x) for x in pair) for pair in value)
        except TypeError:
            raise ValueError("must be three (low, high) pairs for x, y and z") from None

    @field_validator("object_scale_range", mode="before")
    @classmethod
    def _as_range(cls, value: Any) -> Any:
        if isinstance(value, bool):
            raise ValueError("must be a number or a (low, high) pair")
        if isinstance(value, int | float):
            return (float(value), float(value))
        return tuple(value) if isinstance(value, list) else value

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
        return self
