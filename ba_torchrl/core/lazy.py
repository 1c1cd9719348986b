"""Public names of a package whose modules are imported at their first use."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return the ``__getattr__``, the ``__dir__`` and the ``__all__`` of a package.

    Its lazy names are those that its file imports ``if TYPE_CHECKING:``, each ``as`` itself, which
    tells type checkers that it is public. The import of torch and TorchRL takes seconds.

    Args:
        package: its name.
    """
    tree = ast.parse(Path(sys.modules[package].__file__ or "").read_text(encoding="utf-8"))
    modules = {
        alias.asname or alias.name: node.module or ""
        for block in tree.body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    defined = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
    assigned = (node.targets[0] for node in tree.body if isinstance(node, ast.Assign))
    defined += [target.id for target in assigned if isinstance(target, ast.Name)]  # __version__

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(modules[name]), name)

    names = sorted([*modules, *defined])
    return get, lambda: names, names
