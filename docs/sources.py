"""The sources of the package and the recipes as syntax trees, and which names use which.

`docs/architecture.py` and `docs/layout.py` share it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "ba_torchrl"


@cache
def sources() -> dict[str, ast.Module]:
    """Return the syntax tree of every module, by dotted name; a package is its `__init__.py`."""
    trees = {}
    for path in sorted([*(ROOT / PACKAGE).rglob("*.py"), *(ROOT / "recipes").rglob("*.py")]):
        names = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(names[:-1] if names[-1] == "__init__" else names)
        trees[name] = ast.parse(path.read_text(encoding="utf-8"))
    return trees


def file_of(module: str) -> Path:
    """Return the file of a module of the package."""
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@cache
def imports(module: str) -> dict[str, str]:
    """Return what a module imports, in functions as well: from each local name to a dotted name."""
    found = {}
    for node in ast.walk(sources()[module]):
        if isinstance(node, ast.ImportFrom):
            found |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.asname or alias.name: alias.name for alias in node.names}
    return found


@cache
def definitions(module: str) -> dict[str, ast.ClassDef | ast.FunctionDef]:
    """Return the classes and functions at the top level of a module, by name."""
    kinds = ast.ClassDef | ast.FunctionDef
    return {node.name: node for node in sources()[module].body if isinstance(node, kinds)}


class Definition(NamedTuple):
    """A class or function at the top level of a module."""

    module: str
    name: str

    @property
    def node(self) -> ast.ClassDef | ast.FunctionDef:
        """Its syntax tree."""
        return definitions(self.module)[self.name]

    @property
    def names(self) -> list[Definition]:
        """What it names, in the order of its text."""
        return list(named([self.node], self.module))

    @property
    def bases(self) -> set[Definition]:
        """Base classes of the package."""
        bases = getattr(self.node, "bases", [])
        generic = [base.value if isinstance(base, ast.Subscript) else base for base in bases]
        return set(named(generic, self.module))


def named(nodes: list[ast.AST], module: str) -> Iterator[Definition]:
    """Yield the definitions that are named, as ``name`` or ``module.name``, in a module's nodes."""
    for node in nodes:
        for part in ast.walk(node):
            if isinstance(part, ast.Name):
                yield from _defined(imports(module).get(part.id, f"{module}.{part.id}"))
            elif isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name):
                owner = imports(module).get(part.value.id)
                yield from _defined(f"{owner}.{part.attr}")


def _defined(dotted: str) -> Iterator[Definition]:
    module, _, name = dotted.rpartition(".")
    if module in sources() and name in definitions(module):
        yield Definition(module, name)
