"""Types of settings, whose values are checked before a command starts."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import AfterValidator, BeforeValidator, Field, field_validator

from ba_torchrl.core.config import MAX_ENVS, LocalPath, Seed as Seed, StrictModel
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.plugins import load_plugins
from ba_torchrl.tasks.base import TASKS

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from ba_torchrl.envs.settings import ResolvedEnv

MAX_NAME_BYTES = 230
"""Longest name of a file that a command writes. File systems allow 255 bytes, of which temporary
files need some for a prefix and a suffix."""


def checked(check: Callable[[Any], Any]) -> AfterValidator:
    """Return the annotation of a field whose value is kept if ``check`` raises no `ConfigError`."""

    def validate(value: Any) -> Any:
        check(value)
        return value

    return AfterValidator(validate)


def check_new(path: str | Path) -> None:
    """Check that nothing exists at a path."""
    if os.path.lexists(path):
        raise ConfigError(f"{path} exists already; choose another path")


def _folder_exists(path: str) -> None:
    if not os.path.isdir(path):  # False also if the name is too long
        raise ConfigError(f"there is no folder {path}")


def check_writable_folder(folder: str | Path) -> None:
    """Check that files can be written to a folder, or that it can be created; nothing is."""
    folder = Path(folder)
    try:
        there = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
        for part in folder.relative_to(there).parts:
            with contextlib.suppress(FileNotFoundError):
                os.lstat(there / part)  # raises for a name that no folder can have
        if not there.is_dir():
            raise ConfigError(f"cannot write to {folder}: {there} is not a folder")
        with tempfile.TemporaryFile(dir=there):
            pass
    except (OSError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        reason = getattr(error, "strerror", error)
        raise ConfigError(f"cannot write to {folder}: {reason}") from None


def check_writable_file(path: str | Path, suffixes: Sequence[str] = ()) -> None:
    """Check that a file can be written; neither it nor its folder is created."""
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise ConfigError(f"the name of the file must end in {' or '.join(suffixes)}")
    if len(os.fsencode(path.name)) > MAX_NAME_BYTES:
        raise ConfigError(f"cannot write to {path}: the name is too long")
    check_writable_folder(path.parent)
    if os.path.isdir(path):
        raise ConfigError(f"cannot write to {path}: it is a folder; name a file")
    if os.path.exists(path) and not os.access(path, os.W_OK):
        raise ConfigError(f"cannot write to {path}: {os.strerror(errno.EACCES)}")


as_list = BeforeValidator(lambda value: [value] if isinstance(value, str) else value)
"""Annotation of a list that may be given as its only item."""
Count = Annotated[int, Field(ge=1)]
NumEnvs = Annotated[int, Field(ge=1, le=MAX_ENVS)]
Fps = Annotated[float, Field(ge=1, le=240)]
Text = Annotated[str, Field(min_length=1)]
Plugins = Annotated[list[str], checked(load_plugins)]
"""Modules outside the package, imported at once; the first field of a model, as others use them."""
TaskId = Annotated[str, checked(TASKS.__getitem__)]
Tasks = Annotated[list[TaskId], Field(min_length=1), as_list] | None
"""Ids of tasks, or one; None for all."""
Folders = Annotated[
    list[Annotated[LocalPath, checked(_folder_exists)]],
    Field(min_length=1),
    as_list,
]
"""Existing folders, or one."""
OutputFolder = Annotated[LocalPath, checked(check_writable_folder)]
NewPath = Annotated[LocalPath, checked(check_new), checked(check_writable_file)]
PngFile = Annotated[LocalPath, checked(functools.partial(check_writable_file, suffixes=(".png",)))]
VideoFile = Annotated[
    LocalPath, checked(functools.partial(check_writable_file, suffixes=(".mp4", ".gif")))
]


class PluginSettings(StrictModel):
    """Settings of a command that uses tasks, robots or runs."""

    plugins: Plugins = Field(default_factory=list)
    """Modules outside the package that register tasks, robots, ...: [my_tasks]."""


class ActingSettings(PluginSettings):
    """Settings of a command that plays a policy."""

    algorithm: dict[str, Any] = Field(default_factory=dict)
    """Fields that a trained policy acts by, with other values than in its training: with flow and
    flow_dagger, algorithm.executed and algorithm.steps."""


class EnvSettings(PluginSettings):
    """Settings of a command that makes environments."""

    set_by_command: ClassVar[dict[str, str]] = {}
    """By the name of each field of ``env`` that the command sets, what to do instead."""
    env: dict[str, Any] = Field(default_factory=dict)
    """Parameters of the environments."""
    seed: Seed = 0
    """Of the episodes."""

    @field_validator("env")
    @classmethod
    def _check_env(cls, env: dict[str, Any]) -> dict[str, Any]:
        for name in cls.set_by_command.keys() & env:
            raise ConfigError(
                f"{name} is set by the command; leave it out, and {cls.set_by_command[name]}"
            )
        return env


class VectorSettings(PluginSettings):
    """Settings of a command that steps several environments together."""

    num_envs: NumEnvs = 5
    """Environments that step together."""
    parallel: bool | None = None
    """Worker processes; null for processes where at least three can run at a time."""

    def make_env(self, task: str | ResolvedEnv, **fields: Any) -> closing[EnvBase]:
        """Make environments of a task; the context that is returned closes them.

        Args:
            task: id of the task, or its environment.
            fields: further arguments of `ba_torchrl.make_vector_env`.
        """
        from ba_torchrl import make_vector_env

        workers = {"parallel": self.parallel, "register_modules": self.plugins}
        return closing(make_vector_env(task, self.num_envs, **workers, **fields))
