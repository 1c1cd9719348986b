"""One generic registry: tasks, robots, networks and algorithms enter it by decorator."""

from __future__ import annotations

import difflib
import importlib
import pkgutil
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

from ba_torchrl.errors import UnknownNameError

T = TypeVar("T")


class Registry(Generic[T]):
    """Maps names to objects that register themselves when their module is imported.

    Looking anything up first imports every module of ``package``, so that a new file there is
    all it takes to add an entry.

    Args:
        kind: what the entries are, in the singular, for error messages ("task").
        package: dotted name of the package whose modules hold the entries.
    """

    def __init__(self, kind: str, package: str) -> None:
        self.kind = kind
        self.package = package
        self._entries: dict[str, T] = {}
        self._scanned = False

    def register(self, name: str) -> Callable[[T], T]:
        """Return a decorator that files its argument under ``name``.

        Raises:
            ValueError: another object already has that name.
        """

        def decorate(entry: T) -> T:
            known = self._entries.setdefault(name, entry)
            if known is not entry:
                raise ValueError(f"two {self.kind}s are named {name!r}: {known!r} and {entry!r}")
            return entry

        return decorate

    def __getitem__(self, name: str) -> T:
        self._scan()
        try:
            return self._entries[name]
        except KeyError:
            close = difflib.get_close_matches(str(name), self._entries, n=1)
            hint = f" Did you mean {close[0]!r}?" if close else ""
            raise UnknownNameError(
                f"unknown {self.kind} {name!r}.{hint} Known: {', '.join(self)}"
            ) from None

    def __contains__(self, name: object) -> bool:
        self._scan()
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        self._scan()
        return iter(sorted(self._entries))

    def __len__(self) -> int:
        self._scan()
        return len(self._entries)

    def _scan(self) -> None:
        if self._scanned:
            return
        package = importlib.import_module(self.package)
        for module in pkgutil.walk_packages(package.__path__, prefix=f"{self.package}."):
            importlib.import_module(module.name)
        self._scanned = True
