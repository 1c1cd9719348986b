"""What recipes check before their work starts, and how they report errors of configuration."""

from __future__ import annotations

import errno
import functools
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from ba_torchrl.config import MAX_SEED
from ba_torchrl.errors import ConfigError
from ba_torchrl.training import hydra_schema

EXIT_CODE = 2
_RESOURCES = {
    errno.EACCES,
    errno.EDQUOT,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOSPC,
    errno.EPERM,
    errno.EROFS,
}


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

    Resources are disk space, file handles and permissions. The exit code is `EXIT_CODE`.
    """

    @functools.wraps(main)
    def decorated(settings: DictConfig) -> None:
        try:
            main(settings)
        except ConfigError as error:
            _end(error)
        except OSError as error:
            if error.errno not in _RESOURCES:
                raise
            _end(error)

    return decorated


def check_counts(settings: DictConfig, *names: str, least: int = 1) -> None:
    """Check that settings are whole numbers.

    Args:
        settings: of the recipe.
        names: of the settings.
        least: smallest value.

    Raises:
        ConfigError: one of them is not, or is too small.
    """
    for name in names:
        value: Any = settings[name]
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ConfigError(f"{name}: must be a whole number of at least {least}, got {value!r}")


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


def check_lists(settings: DictConfig, *names: str, optional: bool = False) -> None:
    """Check that settings are lists of text.

    Args:
        settings: of the recipe.
        names: of the settings.
        optional: allow None.

    Raises:
        ConfigError: one of them is not.
    """
    for name in names:
        value = settings[name]
        is_list = isinstance(value, ListConfig) and all(isinstance(item, str) for item in value)
        if not (is_list or (optional and value is None)):
            raise ConfigError(f"{name}: must be a list of names, got {value!r}")


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


def check_writable(path: str | Path) -> None:
    """Check that a file can be written to the folder of a path, which is created if needed.

    Raises:
        ConfigError: it cannot.
    """
    folder = Path(path).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigError(f"cannot write to {folder}: {error.strerror}") from None


def _end(error: Exception) -> None:
    sys.stderr.write(f"error: {error}\n")
    sys.exit(EXIT_CODE)
