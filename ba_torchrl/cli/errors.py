"""How commands report errors: on one line, without traceback, with exit code 2."""

from __future__ import annotations

import errno
import functools
import signal
import sys
from collections.abc import Callable
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from ba_torchrl.cli import EXIT_CODE, ends_with_reader
from ba_torchrl.core.errors import ConfigError, as_os_error
from ba_torchrl.training import hydra_schema

_RESOURCES = {
    errno.EACCES,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
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


def plain_errors(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function: errors of configuration and of resources are printed without traceback.

    Resources are memory, disk space, file handles, permissions and names of files. The exit code is
    `ba_torchrl.cli.EXIT_CODE`.
    """

    @functools.wraps(function)
    def decorated(*args: Any, **kwargs: Any) -> Any:
        try:
            with ends_with_reader():
                return function(*args, **kwargs)
        except ConfigError as error:
            _end(error)
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
            if is_memory or type(error).__name__ == "OutOfMemoryError":  # of torch
                _end(error, "out of memory")
            of_system = as_os_error(error)
            if of_system is None or of_system.errno not in _RESOURCES:
                raise
            _end(of_system)
        except KeyboardInterrupt:  # where a run does not note it: before and after its work
            sys.stderr.write("stopped by SIGINT\n")
            sys.exit(128 + signal.SIGINT)

    return decorated


def name_presets(message: str, settings: DictConfig) -> str:
    """Return a message in which algorithm and network have the names of their presets."""
    if not HydraConfig.initialized():
        return message
    choices = HydraConfig.get().runtime.choices
    for group, field in (("replay", "replay: "), ("rotation", "augmentation")):
        if choices.get(group) not in (None, "uniform", "none") and field in message:
            message += f"\n  {group}={choices[group]} sets it; this algorithm cannot have it"
    for group, preset in choices.items():
        chosen = settings.get(group)
        named = f"{group} {chosen.get('name')!r}" if isinstance(chosen, DictConfig) else ""
        is_named = preset and named and named in message
        if is_named and chosen.name in hydra_schema.registries().get(group, {}):
            message = message.replace(named, f"{group} {preset!r}")
        start, listed, names = message.partition(f"tasks take {group}: ")
        if listed:
            presets = hydra_schema.presets_of(group, names.split(", "))
            message = f"{start}{listed}{', '.join(presets)}"
    return message


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
