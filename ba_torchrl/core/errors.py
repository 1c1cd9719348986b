"""The exceptions that users catch."""

from __future__ import annotations

import difflib
import os
import re
import shlex
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, requires


class ConfigError(ValueError):
    """A configuration that cannot be used; the message says what is allowed."""


class UnknownNameError(ConfigError, KeyError):
    """A name that a registry does not hold; the message lists those it holds."""

    def __str__(self) -> str:
        return str(self.args[0])


class MissingPackageError(ConfigError, ImportError):
    """An optional package that is not installed; the message says how to install it."""


def known_names(name: str, known: Sequence[str]) -> str:
    """Return the end of a message on an unknown name: the known ones that have it as a word, or the
    nearest one, and all."""
    close = [each for each in known if re.search(rf"(^|[_/.]){re.escape(name)}($|[_/.])", each)]
    close = close[:3] or difflib.get_close_matches(name, known, n=1)
    meant = f" Did you mean {' or '.join(map(repr, close))}?" if close else ""
    return f"{meant} Known: {', '.join(known)}"


def install_command(*packages: str) -> str:
    """Return the command that installs optional packages in the versions that this one needs.

    Args:
        packages: as ``pyproject.toml`` names them, such as "hydra-core".
    """
    try:
        listed = requires("ba-torchrl") or []
    except PackageNotFoundError:  # run from sources that are not installed
        listed = []
    known = {re.split(r"[^\w.-]", line)[0]: line.split(";")[0].strip() for line in listed}
    return shlex.join(["pip", "install", *(known.get(name, name) for name in packages)])


class DamagedFilesError(ConfigError):
    """Files that are incomplete or altered; the message names the first one."""


class InvalidActionError(ValueError):
    """An action of the wrong shape, or one that is not finite."""


class SimulationError(RuntimeError):
    """The simulator failed, or was asked for something it cannot do."""


class PlacementError(RuntimeError):
    """No free place was found for the objects; the workspace is too small for them."""


class WorkerError(RuntimeError):
    """A worker process raised, died or did not answer in time; the message says which."""


class ReplaySchemaError(ValueError):
    """Transitions whose entries, types or shapes differ from those already stored."""


def as_os_error(error: RuntimeError) -> OSError | None:
    """Return the error of the operating system that a message of torch ends with, or None.

    torch raises RuntimeError for files and shared memory: "...: Too many open files (24)".

    Args:
        error: of torch.
    """
    match = re.search(r"(.*): ([^:]+) \((\d+)\)$", str(error).strip(), re.DOTALL)
    if match is None or os.strerror(int(match[3])) != match[2]:
        return None
    return OSError(int(match[3]), f"{match[2]}: {match[1]}")
