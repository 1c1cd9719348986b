"""The command line: ``ba-torchrl COMMAND [FIELD=VALUE ...]``.

Each module of `ba_torchrl.commands` is a command, and its docstring is the command's description.
"""

from __future__ import annotations

import ast
import gc
import importlib
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ba_torchrl import __version__
from ba_torchrl.core.errors import UnknownNameError, install_command
from ba_torchrl.core.malloc import tune_malloc

PROGRAM = "ba-torchrl"
EXIT_CODE = 2
"""Exit code of a command line that cannot be used."""
OF_TRAINING = (
    "hydra-core",
    "omegaconf",
    "matplotlib",
    "jinja2",
    "imageio-ffmpeg",
    "pillow",
)
"""Packages of the extra [train]."""
_FOLDER = Path(__file__).parents[1] / "commands"


def command_names() -> list[str]:
    """Return the names of the commands."""
    return sorted(path.stem for path in _FOLDER.glob("[!_]*.py"))


@contextmanager
def plain_ends() -> Iterator[None]:
    """Context in which SIGINT, and the end of the reader of the standard output, end the process
    without a traceback. Streams that are closed are those of the null device."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + signal.SIGPIPE)
    except KeyboardInterrupt:  # where a run does not note it: before and after its work
        sys.stderr.write("stopped by SIGINT\n")
        sys.exit(128 + signal.SIGINT)


@contextmanager
def no_collection() -> Iterator[None]:
    """Context without the garbage collector, which takes a tenth of the time of imports, where it
    finds nothing."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@plain_ends()
def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command that a command line names."""
    first, *rest = [*(sys.argv[1:] if arguments is None else arguments)] or ["--help"]
    if first in ("--help", "-h", "help") and rest:
        first, rest = rest[0], ["--help", *rest[1:]]
    if first in ("--help", "-h", "help"):
        print(overview())  # noqa: T201
    elif first == "--version":
        print(f"{PROGRAM} {__version__}")  # noqa: T201
    elif first in command_names():
        tune_malloc()  # before torch allocates anything: halves the time of an update on a CPU
        try:
            folder = os.getcwd()
        except FileNotFoundError:
            sys.stderr.write("error: the working directory was deleted\n")
            sys.exit(EXIT_CODE)
        if folder not in sys.path:  # where `plugins` are, as with `python -m`
            sys.path.insert(0, folder)
        try:
            with no_collection():
                command = importlib.import_module(f"ba_torchrl.commands.{first}").COMMAND
            command.run(rest)
        except ModuleNotFoundError as error:
            end = _missing(first, error)
            if end is None:
                raise
            sys.stderr.write(f"error: {end}\n")
            sys.exit(EXIT_CODE)
    else:
        kind, known = "command", command_names()
        if first.startswith("-"):
            kind, known = "option", ["--help", "--version"]
        sys.stderr.write(f"error: {UnknownNameError(kind, first, known)}\n")
        sys.exit(EXIT_CODE)


def config_dir() -> Path:
    """Return the folder of the configurations."""
    return data_dir("configs")


def data_dir(name: str) -> Path:
    """Return a folder that is beside the package in a clone, and in the installed package."""
    package = _FOLDER.parent
    installed = package / name
    return installed if installed.is_dir() else package.parent / name


def _missing(command: str, error: ModuleNotFoundError) -> str | None:
    """Return the message on a package that a command needs, None if the module is one of ours."""
    name = (error.name or "").split(".")[0]
    package = {"hydra": "hydra-core", "PIL": "pillow"}.get(name, name.replace("_", "-"))
    if package in ("", "ba-torchrl"):
        return None
    is_extra = package in OF_TRAINING
    what = "the extra [train] of the package, of which" if is_extra else "a package:"
    fix = install_command(*(OF_TRAINING if is_extra else [package]))
    return f"{PROGRAM} {command} needs {what} {package!r} is missing: {fix}"


def overview() -> str:
    """Return the list of the commands, each with the first line of its description."""
    lines = [
        "BulletArm's robot-manipulation tasks and equivariant baselines, native to TorchRL.",
        "",
        f"usage: {PROGRAM} COMMAND [FIELD=VALUE ...]",
        f"       {PROGRAM} COMMAND --help",
        "",
    ]
    for name in command_names():
        # read, not imported: the import of torch takes seconds
        source = ast.parse((_FOLDER / f"{name}.py").read_text(encoding="utf-8"))
        lines.append(f"  {name:11} {(ast.get_docstring(source) or '').splitlines()[0]}")
    return "\n".join(lines)
