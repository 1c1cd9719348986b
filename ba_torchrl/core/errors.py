"""The exceptions that users catch."""

from __future__ import annotations

import difflib
import errno
import os
import re
import shlex
import textwrap
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, requires
from typing import Any, get_args

_LISTED_BY = {
    "task": "`ba-torchrl tasks` and ba_torchrl.list_tasks() list them",
    "policy": "`ba-torchrl leaderboard` lists the policies that the package ships",
}
"""By kind of name, what is written in place of many names."""
_MANY = 20
"""Number of known names that are not listed beside the nearest one."""


class ConfigError(ValueError):
    """A configuration that cannot be used; the message says what is allowed."""


class UnknownNameError(ConfigError, KeyError):
    """A name that is not among the known ones; the message has the nearest one, and lists them or
    says what lists them.

    Args:
        kind: of what is named, such as "task".
        name: as it was given. Of a dotted path, the last part is compared.
        known: the names that are.
        hint: end of the message.
        otherwise: further end of the message if no known name is similar.
    """

    def __init__(
        self, kind: str, name: object, known: Iterable[str], hint: str = "", otherwise: str = ""
    ) -> None:
        self.kind, self.name, self.known = kind, name, list(known)
        self.hint, self.otherwise = hint, otherwise
        super().__init__(kind, name, self.known, hint, otherwise)

    def __str__(self) -> str:
        last = str(self.name).rpartition(".")[2]
        word = re.compile(rf"(^|[_/.]){re.escape(last)}($|[_/.])")
        close = [each for each in self.known if word.search(each)][:3]
        close = close or self._nearest(last)
        meant = f" Did you mean {' or '.join(map(repr, close))}?" if close else ""
        known = _LISTED_BY.get(self.kind, f"Known: {', '.join(self.known) or 'none'}")
        if close and len(self.known) > _MANY and self.kind not in _LISTED_BY:
            return f"unknown {self.kind} {self.name!r}.{meant}{self.hint}"
        end = self.hint if close else self.hint + self.otherwise
        return f"unknown {self.kind} {self.name!r}.{meant} {known}{end}"

    def _nearest(self, name: str) -> list[str]:
        """Return the most similar known name, of several the one with most letters in place."""

        def likeness(other: str) -> tuple[float, int]:
            ratio = difflib.SequenceMatcher(None, other, name).ratio()
            return ratio, sum(map(str.__eq__, other, name))

        near = difflib.get_close_matches(name, self.known, n=5)
        return [max(near, key=likeness)] if near else []


def check_choice(name: str, value: object, choices: Any) -> None:
    """Check that an argument is one of the values of a Literal."""
    if value not in get_args(choices):
        known = ", ".join(map(repr, get_args(choices)))
        raise ConfigError(f"{name} is one of {known}, not {value!r}")


class SettingsError(ConfigError):
    """Settings of a part of a configuration that cannot be used.

    Args:
        kind: the part, such as "algorithm".
        name: of the part if it is chosen by one, such as "sac"; else empty.
        problems: fields, and what is wrong with them.
    """

    def __init__(self, kind: str, name: str, problems: list[tuple[str, str]]) -> None:
        self.kind, self.name, self.problems = kind, name, problems
        super().__init__(kind, name, problems)

    def __str__(self) -> str:
        named = f"{self.kind} {self.name!r}" if self.name else self.kind
        return "\n  ".join([f"invalid {named}:", *(text for _, text in self.problems)])


class PartError(ConfigError):
    """A part of a configuration that does not fit the others.

    Args:
        kind: the part, such as "algorithm".
        name: of the one that is chosen, such as "sac".
        problem: what is wrong.
        instead: names of those that fit, after ``before``; empty if the problem says what to do.
        before: what takes them.
    """

    def __init__(
        self, kind: str, name: str, problem: str, instead: Sequence[str] = (), before: str = ""
    ) -> None:
        self.kind, self.name, self.problem = kind, name, problem
        self.instead, self.before = instead, before
        super().__init__(kind, name, problem, instead, before)

    def __str__(self) -> str:
        end = f"; {self.before} take {self.kind}: {', '.join(self.instead)}" if self.instead else ""
        return f"{self.kind} {self.name!r} {self.problem}{end}"


class MissingPackageError(ConfigError, ImportError):
    """An optional package that is not installed.

    Args:
        what: needs it.
        fix: the command that installs it.
    """

    def __init__(self, what: str, fix: str) -> None:
        self.what, self.fix = what, fix
        super().__init__(what, fix)

    def __str__(self) -> str:
        return f"{self.what}: {self.fix}"


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


def in_one_line(error: Exception) -> str:
    """Return the type and the text of a library's exception in at most 300 characters."""
    return textwrap.shorten(f"{type(error).__name__}: {error}", 300)


class DamagedFilesError(ConfigError):
    """Files that are incomplete or altered; the message names the first one."""


class OtherRunError(ConfigError):
    """A folder that holds a run with other settings, or of another version of its task."""


class InvalidActionError(ValueError):
    """An action of the wrong shape, or one that is not finite."""


class SimulationError(RuntimeError):
    """The simulator failed, or was asked for something it cannot do."""


class RepeatedFaultError(SimulationError):
    """The simulator failed in many episodes in a row, probably because of the task's code.

    It ends a run, where another `SimulationError` ends an episode.
    """


class PlacementError(RuntimeError):
    """No free place was found for the objects; the workspace is too small for them."""


class WorkerError(RuntimeError):
    """A worker process raised, died or did not answer in time; the message says which."""


class ReplaySchemaError(ValueError):
    """Transitions whose entries, types or shapes differ from those already stored."""


class BatchError(ValueError, KeyError):
    """A batch whose entries, types or shapes a loss or a network cannot use."""

    def __str__(self) -> str:
        return str(self.args[0])


def layout(dtype: object, shape: Iterable[int]) -> str:
    """Return the type and shape of a tensor as text, such as "float32[6, 1]"."""
    return f"{str(dtype).removeprefix('torch.')}{list(shape)}"


def as_os_error(error: RuntimeError) -> OSError | None:
    """Return the error of the operating system that torch's text tells of, or None.

    torch raises RuntimeError for files and shared memory, "...: Too many open files (24)", and
    where the memory of the CPU is exhausted.
    """
    text = str(error).strip()
    if "an't allocate memory" in text or "annot allocate memory" in text:
        return OSError(errno.ENOMEM, f"{os.strerror(errno.ENOMEM)}: {text}")
    match = re.search(r"(.*): ([^:]+) \((\d+)\)$", text, re.DOTALL)
    if match is None or os.strerror(int(match[3])) != match[2]:
        return None
    return OSError(int(match[3]), f"{match[2]}: {match[1]}")
