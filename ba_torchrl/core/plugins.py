"""Plugins: modules outside the package that register tasks, robots, networks or algorithms.

A plugin is an importable module; its import runs the decorators. It is imported by the user's code,
by name (``register_modules`` of worker processes, ``plugins`` of recipes and run configurations),
or as an entry point of an installed package in the group ``ba_torchrl.plugins``.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
import traceback
import warnings
from collections.abc import Iterable
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from ba_torchrl.core.errors import ConfigError

GROUP = "ba_torchrl.plugins"
"""Group of entry points; the value of each is the dotted name of a module."""

MAIN = ("__main__", "__mp_main__")
"""Names of a process's main module, in the process itself and in its spawned children."""

_IMPORT_FILES = re.compile(rf"importlib|{re.escape(__file__)}")
"""Part of the names of files that import a plugin."""

_loaded_groups: set[str] = set()


class PluginWarning(UserWarning):
    """An installed plugin cannot be imported."""


def has_entry_points() -> bool:
    """Whether installed packages declare plugins."""
    return bool(entry_points(group=GROUP))


def load_entry_points() -> None:
    """Import the plugins that installed packages declare, once per process.

    A plugin that cannot be imported causes a `PluginWarning` with its name; the others are loaded.
    """
    if GROUP in _loaded_groups:
        return
    _loaded_groups.add(GROUP)
    for point in entry_points(group=GROUP):
        try:
            point.load()
        except (Exception, SystemExit) as error:
            package = f" of {point.dist.name}" if point.dist is not None else ""
            warnings.warn(
                f"the plugin {point.name!r} ({point.value}){package} is not loaded: "
                + _summary(error),
                PluginWarning,
                stacklevel=2,
            )


def module_names(modules: Iterable[str | ModuleType]) -> tuple[str, ...]:
    """Return the dotted names of modules that are given by name or as module objects."""
    return tuple(
        module.__name__ if isinstance(module, ModuleType) else module for module in modules
    )


def import_modules(names: Iterable[str]) -> None:
    """Import plugins by name.

    Raises:
        ConfigError: a module does not exist, and the message names possible fixes; or it raises at
            its import, which is the cause.
    """
    for name in names:
        if not _is_module_name(name):
            raise ConfigError(f"plugins: {name!r} is not the name of a module, such as my.tasks")
        try:
            importlib.import_module(name)
        except (Exception, SystemExit) as error:
            missing = error.name if isinstance(error, ModuleNotFoundError) else None
            if missing is None or not f"{name}.".startswith(f"{missing}."):
                raise ConfigError(
                    f"cannot import the plugin {name!r}: {_summary(error)}"
                ) from error
            raise ConfigError(
                f"cannot import the plugin {name!r}: there is no module {missing!r}. "
                + ("Leave out '.py', run" if name.endswith(".py") else "Run")
                + " from the folder that holds it, put that folder on PYTHONPATH, or install the "
                "package"
            ) from None


def _is_module_name(name: object) -> bool:
    return isinstance(name, str) and all(map(str.isidentifier, name.split(".")))


def _summary(error: BaseException) -> str:
    """Return an error of an import on one line, with the last place in the plugin's files."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    frames = traceback.extract_tb(error.__traceback__)
    places = [frame for frame in frames if not _IMPORT_FILES.search(frame.filename)]
    return f"{text} ({places[-1].filename}, line {places[-1].lineno})" if places else text


def load_plugins(names: Iterable[str]) -> None:
    """Import the plugins of a recipe or a run, also from the current directory."""
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise ConfigError(f"plugins: must be a list of names of modules, got {names!r}")
    names = list(names)
    if names and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    import_modules(names)


def check_known(names: object, file: str | Path) -> None:
    """Raise `ConfigError` unless this process has imported the plugins that a file names, which may
    come from somebody else, or an installed package declares them. None is imported, and what is no
    list is left to the model of the settings."""
    listed = map(str, names) if isinstance(names, list) else ()
    if not (unknown := [name for name in listed if name not in sys.modules]):
        return  # a search of the installed packages takes longer than the rest of a file's reading
    installed = {point.module for point in entry_points(group=GROUP)}
    unknown = [name for name in unknown if name not in installed]
    if wrong := [name for name in unknown if not _is_module_name(name)]:
        raise ConfigError(f"{file}: plugins: {wrong[0]!r} is not the name of a module")
    if unknown:
        text = ",".join(unknown)
        raise ConfigError(
            f"{file} uses the plugins [{text}]: modules outside this package, whose import runs "
            f"their code. If you trust them, add 'plugins=[{text}]', or import them first"
        )


def check_spawned_process_knows(kind: str, name: str) -> None:
    """Check that a spawned process can import the main module of this process.

    The main module of a script and of ``python -m`` can be imported. That of a notebook, an
    interactive session and ``python -c`` cannot.

    Args:
        kind: kind of the registered entry, such as "task".
        name: name of the entry, which the main module registered.

    Raises:
        ConfigError: the main module cannot be imported.
    """
    main = sys.modules["__main__"]
    if getattr(main, "__spec__", None) is None and not hasattr(main, "__file__"):
        raise ConfigError(
            f"the {kind} {name!r} is defined in a notebook or an interactive session, which worker "
            "processes cannot import: move it to a module and import that, or make the "
            'environments with parallel=False or start_method="fork"'
        )
