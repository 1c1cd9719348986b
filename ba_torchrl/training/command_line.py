"""Settings of commands as validated models, and how commands report errors of configuration."""

from __future__ import annotations

import errno
import functools
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import AfterValidator, BeforeValidator, Field

from ba_torchrl.config import MAX_SEED, Model, parse
from ba_torchrl.data.time_reversal import check_has_structure
from ba_torchrl.envs.vector.make import MAX_ENVS
from ba_torchrl.errors import ConfigError, as_os_error
from ba_torchrl.plugins import load_plugins
from ba_torchrl.record.logging import limit_library_logs
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training import hydra_schema

EXIT_CODE = 2
MAX_NAME_BYTES = 230
"""Longest name of a file that a recipe writes. File systems allow 255 bytes, of which temporary
files need some for a prefix and a suffix."""
_RESOURCES = {
    errno.EACCES,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EISDIR,
    errno.ELOOP,
    errno.EMFILE,
    errno.ENAMETOOLONG,
    errno.ENFILE,
    errno.ENOSPC,
    errno.ENOTDIR,
    errno.EPERM,
    errno.EROFS,
}
_OUT_OF_MEMORY = ("can't allocate memory", "Cannot allocate memory")
"""Parts of the messages of torch's RuntimeError when the CPU's memory is exhausted."""


def register_schemas() -> None:
    """Make the schemas known to Hydra, with the plugins that the command line names.

    An error is printed without traceback, as by `plain_errors`.
    """
    try:
        hydra_schema.register(sys.argv[1:])
    except ConfigError as error:
        _end(error)


def plain_errors(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Decorate a recipe: errors of configuration and of resources are printed without traceback.

    Resources are memory, disk space, file handles, permissions and names of files. The exit code is
    `EXIT_CODE`.
    """

    @functools.wraps(main)
    def decorated(settings: DictConfig) -> None:
        try:
            main(settings)
        except ConfigError as error:
            _end(ConfigError(_name_presets(str(error), settings)))
        except OmegaConfBaseException as error:  # a missing value, or a wrong interpolation
            _end(error, lines=1)
        except OSError as error:
            if error.errno not in _RESOURCES:
                raise
            _end(error)
        except MemoryError as error:
            _end(error, "out of memory")
        except RuntimeError as error:
            is_memory = any(words in str(error) for words in _OUT_OF_MEMORY)
            if is_memory or isinstance(error, torch.OutOfMemoryError):
                _end(error, "out of memory")
            of_system = as_os_error(error)
            if of_system is None or of_system.errno not in _RESOURCES:
                raise
            _end(of_system)
        except KeyboardInterrupt:  # where a run does not note it: before and after its work
            sys.stderr.write("stopped by SIGINT\n")
            sys.exit(128 + signal.SIGINT)

    return decorated


def command(model: type[Model]) -> Callable[..., Callable[[DictConfig], None]]:
    """Decorate the main function of a command: its settings are validated before it starts.

    Errors are printed as by `plain_errors`.

    Args:
        model: the settings; the function gets an instance.
    """

    def decorate(main: Callable[[Model], None]) -> Callable[[DictConfig], None]:
        @functools.wraps(main)
        @plain_errors
        def decorated(settings: DictConfig) -> None:
            limit_library_logs()
            values = OmegaConf.to_container(settings, resolve=True, throw_on_missing=True)
            main(parse(model, values, "settings"))

        return decorated

    return decorate


def _name_presets(message: str, settings: DictConfig) -> str:
    """Return a message in which algorithm and network have the names of their presets."""
    if not HydraConfig.initialized():
        return message
    choices = HydraConfig.get().runtime.choices
    for group, field in (("replay", "replay: "), ("rotation", "augmentation")):
        if choices.get(group) not in (None, "uniform", "none") and field in message:
            message += f"\n  {group}={choices[group]} sets it; this algorithm cannot have it"
    for group, preset in choices.items():
        chosen = settings.get(group)
        if preset and isinstance(chosen, DictConfig) and "name" in chosen:
            message = message.replace(f"{group} {chosen.name!r}", f"{group} {preset!r}")
        start, listed, names = message.partition(f"tasks take {group}: ")
        if listed:
            presets = hydra_schema.presets_of(group, names.split(", "))
            message = f"{start}{listed}{', '.join(presets)}"
    return message


def checked(check: Callable[[Any], Any]) -> AfterValidator:
    """Return the annotation of a field whose value is kept if ``check`` raises no `ConfigError`."""

    def validate(value: Any) -> Any:
        check(value)
        return value

    return AfterValidator(validate)


def without(values: dict[str, Any], **reserved: str) -> dict[str, Any]:
    """Return fields of `EnvConfig`, none of which the command sets itself.

    Args:
        values: the fields.
        reserved: by the name of each field that the command sets, what to do instead.

    Raises:
        ConfigError: one of them is given.
    """
    for name, instead in reserved.items():
        if name in values:
            raise ConfigError(f"{name} is set by the command; leave it out, and {instead}")
    return values


def _is_new(path: str) -> None:
    if os.path.exists(path):
        raise ConfigError(f"{path} exists already; choose another path")


def _folder_exists(path: str) -> None:
    if not os.path.isdir(path):  # False also if the name is too long
        raise ConfigError(f"there is no folder {path}")


def check_writable_folder(folder: str | Path) -> None:
    """Check that files can be written to a folder, which is created if needed.

    Raises:
        ConfigError: they cannot.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except FileExistsError:
        raise ConfigError(f"cannot write to {_short(folder)}: it is not a folder") from None
    except OSError as error:
        raise ConfigError(f"cannot write to {_short(folder)}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"cannot write to {folder!r}: {error}") from None


def check_writable_file(path: str | Path, suffixes: Sequence[str] = ()) -> None:
    """Check that a file can be written; its folder is created if needed.

    Args:
        path: of the file.
        suffixes: allowed ends of its name; any if left out.

    Raises:
        ConfigError: it cannot, its name has another end, or it is a folder.
    """
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise ConfigError(f"the name of the file ends in {' or '.join(suffixes)}, not {path.name}")
    if len(os.fsencode(path.name)) > MAX_NAME_BYTES:
        raise ConfigError(f"cannot write to {_short(path)}: the name is too long")
    check_writable_folder(path.parent)
    if os.path.isdir(path):
        raise ConfigError(f"cannot write to {path}: it is a folder; name a file")
    if os.path.exists(path) and not os.access(path, os.W_OK):
        raise ConfigError(f"cannot write to {path}: {os.strerror(errno.EACCES)}")


Count = Annotated[int, Field(ge=1)]
NumEnvs = Annotated[int, Field(ge=1, le=MAX_ENVS)]
Seed = Annotated[int, Field(ge=0, le=MAX_SEED)]
Text = Annotated[str, Field(min_length=1)]
Plugins = Annotated[list[str], checked(load_plugins)]
"""Modules outside the package, imported at once; the first field of a model, as others use them."""
TaskId = Annotated[str, checked(TASKS.__getitem__)]
Tasks = Annotated[list[TaskId], Field(min_length=1)] | None
"""Ids of tasks; None for all."""
Folders = Annotated[
    list[Annotated[Text, checked(_folder_exists)]],
    Field(min_length=1),
    BeforeValidator(lambda value: [value] if isinstance(value, str) else value),
]
"""Existing folders, or one."""
OutputFolder = Annotated[Text, checked(check_writable_folder)]
OutputFile = Annotated[Text, checked(check_writable_file)]
NewPath = Annotated[Text, checked(_is_new), checked(check_writable_file)]
PngFile = Annotated[Text, checked(functools.partial(check_writable_file, suffixes=(".png",)))]
VideoFile = Annotated[
    Text, checked(functools.partial(check_writable_file, suffixes=(".mp4", ".gif")))
]
Structures = list[Annotated[str, checked(check_has_structure)]]
"""Ids of tasks whose structures can be deconstructed."""


def _short(path: str | Path) -> str:
    """Return a path as text of at most 200 characters."""
    text = str(path)
    return text if len(text) <= 200 else f"{text[:100]}...{text[-80:]}"


def _end(error: Exception, kind: str = "", lines: int | None = None) -> None:
    """Print an error on one line and exit.

    Args:
        error: its message is printed.
        kind: printed before the message.
        lines: number of lines of the message that are printed; None for all.
    """
    found = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = "; ".join(found[:lines]).replace(":; ", ": ")
    sys.stderr.write(f"error: {': '.join(part for part in (kind, text) if part)}\n")
    sys.exit(EXIT_CODE)
