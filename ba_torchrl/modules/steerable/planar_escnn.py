"""The import of escnn without its dependencies for rotations in space.

escnn imports `lie_learn`, whose wheels need NumPy 1, for the irreducible representations of SO(3),
and tries `py3nj`, which needs a Fortran compiler, for its Clebsch-Gordan coefficients. The planar
groups need neither.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from types import ModuleType
from typing import Any

from ba_torchrl.errors import MissingPackageError, install_command

ESCNN_FIX = "equivariant networks need escnn: pip install --no-deps escnn==1.0.11"
_NAMES = ("lie_learn", "representations", "SO3", "wigner_d")


def import_escnn(name: str = "escnn") -> ModuleType:
    """Import a module of escnn.

    Args:
        name: of the module.

    Raises:
        ImportError: escnn is not installed; the message names the fix.
    """
    _replace_lie_learn()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*py3nj")
            importlib.import_module("escnn")
            module = importlib.import_module(name)
    except ImportError as error:
        other = (error.name or "").split(".")[0]  # a package that escnn imports
        fix = ESCNN_FIX
        if other not in ("", "escnn"):
            fix = f"equivariant networks need {other}: {install_command(other)}"
        raise MissingPackageError(fix) from error
    # scikit-learn's singular value decomposition refuses the matrices that escnn gives it; where
    # scikit-learn is not installed, escnn takes SciPy's.
    importlib.import_module("escnn.group._numerical").randomized_svd = None
    return module


def _replace_lie_learn() -> None:
    """Put a module in the place of `lie_learn` if that cannot be imported."""
    full = ".".join(_NAMES)
    if full in sys.modules:
        return
    try:
        importlib.import_module(full)
    except (ImportError, ValueError, AttributeError):  # absent, or built for another NumPy
        for name in [name for name in sys.modules if name.split(".")[0] == _NAMES[0]]:
            del sys.modules[name]
        for end in range(len(_NAMES)):
            name = ".".join(_NAMES[: end + 1])
            sys.modules[name] = ModuleType(name, "Stands in for a package that is not installed.")
        sys.modules[full].wigner_D_matrix = _raise


def _raise(*_: Any, **__: Any) -> None:
    raise MissingPackageError(
        "escnn's representations of SO(3) need lie_learn and NumPy 1: pip install lie_learn"
    )
