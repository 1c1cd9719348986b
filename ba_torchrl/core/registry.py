"""Registry: tasks, robots, observations, networks and algorithms register by decorator."""

from __future__ import annotations

import importlib
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

from ba_torchrl.core.errors import ConfigError, UnknownNameError
from ba_torchrl.core.plugins import load_entry_points

T = TypeVar("T")

_NAME = re.compile(r"[\w.-]+(/[\w.-]+)*")
PACKAGE = __name__.partition(".")[0]

_LISTENERS: dict[str, list[Callable[[str], None]]] = {}
"""By kind of entry, functions that are called with the name of each new entry."""


def call_on_registration(kind: str, listener: Callable[[str], None]) -> None:
    """Call a function with the name of every entry that registers from now on.

    Args:
        kind: of the entries, as given to `Registry`.
        listener: gets the name, after the registry holds the entry.
    """
    _LISTENERS.setdefault(kind, []).append(listener)


class Registry(Generic[T]):
    """Maps names to objects that register themselves when their module is imported.

    The first look-up imports every module of ``package`` and the plugins that installed packages
    declare (`ba_torchrl.core.plugins`). A module elsewhere adds its entries when it is imported.

    Args:
        kind: what the entries are, in the singular, for error messages ("task").
        package: dotted name of the package whose modules hold the built-in entries.
        base: class of the entries, or from which they derive.
        ending: of the names of the modules that hold the built-in entries; others are not imported.
    """

    def __init__(self, kind: str, package: str, base: type = object, ending: str = "") -> None:
        self.kind = kind
        self.package = package
        self.base = base
        self.ending = ending
        self._entries: dict[str, T] = {}
        self._modules: dict[str, str] = {}
        self._is_scanned = False

    def register(self, name: str) -> Callable[[T], T]:
        """Return a decorator that registers its argument under ``name``.

        A class may be defined again by its own module, as in a notebook whose cell runs twice; the
        new definition replaces the old one.

        Raises:
            ConfigError: another object already has that name, or it is not one; or the argument
                does not derive from the base class.
        """
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise ConfigError(
                f"register takes a name such as 'mine/{self.kind.replace(' ', '_')}', of letters, "
                f"digits, '_', '-', '.' and '/', not {name!r}"
            )
        module = sys._getframe(1).f_globals.get("__name__", "__main__")

        def decorate(entry: T) -> T:
            if not issubclass(entry if isinstance(entry, type) else type(entry), self.base):
                base = f"{self.base.__module__}.{self.base.__qualname__}"
                raise ConfigError(f"{self.kind} {name!r}: {entry!r} does not derive from {base}")
            known = self._entries.get(name, entry)
            if known is not entry and not _is_redefinition(known, entry):
                modules = {self._modules[name], module}
                foreign = sorted(each for each in modules if each.partition(".")[0] != PACKAGE)
                raise ConfigError(
                    f"two {self.kind}s are named {name!r}: {known!r} and {entry!r}. Choose another "
                    f"name in {' or '.join(foreign) or module}"
                )
            self._entries[name] = entry
            self._modules[name] = module
            for listener in _LISTENERS.get(self.kind, ()):
                listener(name)
            return entry

        return decorate

    def name_of(self, entry: T) -> str:
        """Return the name of an entry, for error messages; its own if it is not registered."""
        known = (
            name
            for name in self
            if self._entries[name] is entry or _is_redefinition(self._entries[name], entry)
        )
        return next(known, getattr(entry, "__name__", repr(entry)))

    def entry(self, name: str) -> T:
        """Return an entry; if it is registered, without the imports of the first look-up."""
        return self._entries[name] if name in self._entries else self[name]

    def plugin_names(self) -> list[str]:
        """Return the names that modules outside the package have registered, without the imports of
        the first look-up."""
        load_entry_points()
        return sorted(name for name in self._entries if self.plugin_module(name) is not None)

    def plugin_module(self, name: str) -> str | None:
        """Return the module outside the package that registered a name; None if it is built in."""
        self.entry(name)
        module = self._modules[name]
        return None if module.partition(".")[0] == PACKAGE else module

    def __getitem__(self, name: str) -> T:
        self._scan()
        try:
            return self._entries[name]
        except (KeyError, TypeError):  # a list is not hashable
            hint = (
                ". To use your own, import its module first (commands: 'plugins=[module]'; "
                "worker processes: register_modules=[module])"
            )
            raise UnknownNameError(self.kind, name, self, otherwise=hint) from None

    def __contains__(self, name: object) -> bool:
        self._scan()
        return isinstance(name, str) and name in self._entries  # a list is not hashable

    def __iter__(self) -> Iterator[str]:
        self._scan()
        return iter(sorted(self._entries))

    def __len__(self) -> int:
        self._scan()
        return len(self._entries)

    def _scan(self) -> None:
        if self._is_scanned:
            return
        package = importlib.import_module(self.package)
        for module in pkgutil.walk_packages(package.__path__, prefix=f"{self.package}."):
            if module.name.endswith(self.ending):
                importlib.import_module(module.name)
        load_entry_points()
        self._is_scanned = True


def _is_redefinition(known: object, entry: object) -> bool:
    """Whether two classes are definitions of the same name in the same module."""
    return (
        isinstance(known, type)
        and isinstance(entry, type)
        and (known.__module__, known.__qualname__) == (entry.__module__, entry.__qualname__)
    )
