"""What recipes check before their work starts, and how they report errors of configuration."""

from __future__ import annotations

import errno
import functools
import os
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ba_torchrl.config import MAX_SEED
from ba_torchrl.data.time_reversal import check_has_structure
from ba_torchrl.errors import ConfigError, as_os_error
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


def _name_presets(message: str, settings: DictConfig) -> str:
    """Return a message in which algorithm and network have the names of their presets."""
    if not HydraConfig.initialized():
        return message
    for group, preset in HydraConfig.get().runtime.choices.items():
        chosen = settings.get(group)
        if preset and isinstance(chosen, DictConfig) and "name" in chosen:
            message = message.replace(f"{group} {chosen.name!r}", f"{group} {preset!r}")
    return message


def check_known(settings: DictConfig) -> None:
    """Check that a recipe has all settings that the command line adds to its configuration.

    Args:
        settings: of the recipe, within its main function.

    Raises:
        ConfigError: a setting is unknown.
    """
    if not HydraConfig.initialized():  # called from Python, without a command line
        return
    started = HydraConfig.get()
    if not any(each.startswith("+") for each in started.overrides.task):
        return
    known = {str(name) for name in compose(started.job.config_name)}
    unknown = [str(name) for name in settings if name not in known]
    if unknown:
        raise ConfigError(f"unknown setting {unknown[0]!r}. Known: {', '.join(sorted(known))}")


def check_counts(
    settings: DictConfig, *names: str, least: int = 1, most: int | None = None
) -> None:
    """Check that settings are whole numbers.

    Args:
        settings: of the recipe.
        names: of the settings.
        least: smallest value.
        most: largest value; None for no limit.

    Raises:
        ConfigError: one of them is not, or is too small or too large.
    """
    wanted = f"of at least {least}" if most is None else f"from {least} to {most}"
    for name in names:
        value: Any = settings[name]
        is_number = isinstance(value, int) and not isinstance(value, bool)
        if not is_number or value < least or (most is not None and value > most):
            raise ConfigError(f"{name}: must be a whole number {wanted}, got {value!r}")


def check_flags(settings: DictConfig, *names: str, optional: bool = False) -> None:
    """Check that settings are true or false.

    Args:
        settings: of the recipe.
        names: of the settings.
        optional: allow None.

    Raises:
        ConfigError: one of them is neither.
    """
    for name in names:
        value = settings[name]
        if not isinstance(value, bool) and not (optional and value is None):
            allowed = "true, false or null" if optional else "true or false"
            raise ConfigError(f"{name}: must be {allowed}, got {value!r}")


def check_seed(settings: DictConfig, *, optional: bool = False) -> None:
    """Check the setting ``seed``.

    Args:
        settings: of the recipe.
        optional: allow None.

    Raises:
        ConfigError: it is not a whole number from zero to `MAX_SEED`.
    """
    value: Any = settings.seed
    if optional and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_SEED:
        raise ConfigError(f"seed: must be a whole number from 0 to {MAX_SEED}, got {value!r}")


def check_texts(settings: DictConfig, *names: str, optional: bool = False) -> None:
    """Check that settings are text, such as a path or the id of a task.

    Args:
        settings: of the recipe.
        names: of the settings.
        optional: allow None.

    Raises:
        ConfigError: one of them is not, or is empty.
    """
    for name in names:
        value = settings[name]
        if not (optional and value is None) and not (isinstance(value, str) and value):
            raise ConfigError(f"{name}: must be text, got {value!r}")


def check_lists(settings: DictConfig, *names: str, optional: bool = False, least: int = 0) -> None:
    """Check that settings are lists of text.

    Args:
        settings: of the recipe.
        names: of the settings.
        optional: allow None.
        least: smallest number of names in the list.

    Raises:
        ConfigError: one of them is not, or has too few names.
    """
    for name in names:
        value = settings[name]
        if optional and value is None:
            continue
        if not isinstance(value, ListConfig) or not all(isinstance(item, str) for item in value):
            raise ConfigError(f"{name}: must be a list of names, got {value!r}")
        if len(value) < least:
            raise ConfigError(f"{name}: the list is empty")


def check_tasks(settings: DictConfig, name: str = "tasks") -> None:
    """Check that a setting is None, or a list of ids of tasks that is not empty.

    Args:
        settings: of the recipe.
        name: of the setting.

    Raises:
        ConfigError: it is something else, or a task is unknown.
    """
    check_lists(settings, name, optional=True, least=1)
    for task in settings[name] or ():
        _ = TASKS[task]  # raises with the known names


def check_deconstructions(settings: DictConfig, name: str) -> None:
    """Check that a setting is a list of ids of tasks whose structures can be deconstructed.

    Args:
        settings: of the recipe.
        name: of the setting.

    Raises:
        ConfigError: it is something else, or one of the tasks has no such structure.
    """
    check_lists(settings, name)
    for task in settings[name]:
        check_has_structure(task)


def folders_of(settings: DictConfig, name: str) -> list[str]:
    """Return a setting that is a folder or a list of folders.

    Args:
        settings: of the recipe.
        name: of the setting.

    Raises:
        ConfigError: it is something else, the list is empty, or a folder does not exist.
    """
    value = settings[name]
    folders = [value] if isinstance(value, str) else value
    is_list = isinstance(folders, list | ListConfig) and len(folders) > 0
    if not is_list or not all(isinstance(folder, str) and folder for folder in folders):
        raise ConfigError(f"{name}: must be a folder or a list of folders, got {value!r}")
    for folder in folders:
        if not os.path.isdir(folder):  # False also if the name is too long
            raise ConfigError(f"{name}: there is no folder {folder}")
    return list(folders)


def mapping_of(settings: DictConfig, name: str) -> dict[str, Any]:
    """Return a group of settings as a dictionary.

    Args:
        settings: of the recipe.
        name: of the group, such as "env".

    Raises:
        ConfigError: it is not a group.
    """
    value = settings[name]
    if not isinstance(value, DictConfig):
        raise ConfigError(f"{name}: must be a group of settings, got {value!r}")
    return OmegaConf.to_container(value, resolve=True)


def env_of(settings: DictConfig, **reserved: str) -> dict[str, Any]:
    """Return the fields of `EnvConfig` in the group ``env``.

    Args:
        settings: of the recipe.
        reserved: by field that the recipe sets itself, what to set in its place.

    Raises:
        ConfigError: it is not a group, or a reserved field is set.
    """
    env = mapping_of(settings, "env")
    for name, instead in reserved.items():
        if name in env:
            raise ConfigError(f"env.{name} is set by the recipe; leave it out, and set {instead}")
    return env


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


def check_writable_file(path: str | Path, *suffixes: str) -> None:
    """Check that a file can be written; its folder is created if needed.

    Args:
        path: of the file.
        suffixes: allowed ends of its name; any if left out.

    Raises:
        ConfigError: it cannot, its name has another end, or it is a folder.
    """
    path = Path(path)
    if suffixes and path.suffix not in suffixes:
        raise ConfigError(f"the name of the file ends in {' or '.join(suffixes)}, not {path.name}")
    if len(os.fsencode(path.name)) > MAX_NAME_BYTES:
        raise ConfigError(f"cannot write to {_short(path)}: the name is too long")
    check_writable_folder(path.parent)
    if os.path.isdir(path):
        raise ConfigError(f"cannot write to {path}: it is a folder; name a file")
    if os.path.exists(path) and not os.access(path, os.W_OK):
        raise ConfigError(f"cannot write to {path}: {os.strerror(errno.EACCES)}")


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
