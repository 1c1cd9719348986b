"""The import of escnn without its dependencies for rotations in space, and with definite signs.

escnn imports `lie_learn`, whose wheels need NumPy 1, for the irreducible representations of SO(3),
and tries `py3nj`, which needs a Fortran compiler, for its Clebsch-Gordan coefficients. The planar
groups need neither.

escnn computes the Clebsch-Gordan coefficients of dihedral groups by singular value decomposition,
so that their signs differ between CPUs. A policy's weights are coefficients of kernels with these
signs. `import_escnn` makes the signs the same everywhere, for all uses of escnn in the process.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable
from functools import wraps
from types import ModuleType
from typing import Any

import numpy as np

from ba_torchrl.core.errors import MissingPackageError

ESCNN_FIX = "pip install --no-deps escnn==1.0.11 joblib"
_NAMES = ("lie_learn", "representations", "SO3", "wigner_d")


def import_escnn(name: str = "escnn") -> ModuleType:
    """Import a module of escnn.

    Raises:
        ImportError: escnn is not installed; the message names the fix.
    """
    _replace_lie_learn()
    if "escnn.nn" not in sys.modules:  # imported before in part, without lie_learn
        _forget("escnn")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*py3nj")
            importlib.import_module("escnn")
            module = importlib.import_module(name)
            numerical = importlib.import_module("escnn.group._numerical")
            coefficients = importlib.import_module("escnn.group._clebsh_gordan")
    except ImportError as error:
        other = (error.name or "").split(".")[0]  # a package that escnn imports
        missing = other or "escnn"
        raise MissingPackageError(f"{missing} is not installed", ESCNN_FIX) from error
    # scikit-learn's singular value decomposition refuses the matrices that escnn gives it; where
    # scikit-learn is not installed, escnn takes SciPy's.
    numerical.randomized_svd = None
    _fix_signs(coefficients)
    return module


def _fix_signs(coefficients: ModuleType) -> None:
    """Replace escnn's Clebsch-Gordan coefficients by those whose first large entry is positive.

    A representation occurs at most once in the product of two others of a dihedral group, so that
    only the sign is undetermined; escnn computes those of cyclic groups in closed form.
    """
    if hasattr(coefficients._clebsh_gordan_tensor, "signs_are_fixed"):
        return
    coefficients._clebsh_gordan_tensor = _with_fixed_signs(coefficients._clebsh_gordan_tensor)
    solver = importlib.import_module("escnn.kernels.wignereckart_solver")
    for basis in (solver.WignerEckartBasis, solver.RestrictedWignerEckartBasis):
        basis._cached_instances.clear()  # of layers that were made before


def _with_fixed_signs(tensor: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    @wraps(tensor)
    def fixed(*args: Any, **kwargs: Any) -> np.ndarray:
        found = tensor(*args, **kwargs)  # [J, l, multiplicity, j]
        if found.size == 0:  # the representation does not occur in the product
            return found
        values = found.transpose(2, 0, 1, 3).reshape(found.shape[2], -1)
        size = np.abs(values)
        first = np.argmax(size > size.max(axis=1, keepdims=True) / 2, axis=1)
        signs = np.sign(values[np.arange(len(values)), first])
        return found * signs[:, None]

    fixed.signs_are_fixed = True
    return fixed


def _replace_lie_learn() -> None:
    """Put a module in the place of `lie_learn` if that cannot be imported."""
    full = ".".join(_NAMES)
    if full in sys.modules:
        return
    try:
        importlib.import_module(full)
    except (ImportError, ValueError, AttributeError):  # absent, or built for another NumPy
        _forget(_NAMES[0])
        for end in range(len(_NAMES)):
            name = ".".join(_NAMES[: end + 1])
            sys.modules[name] = ModuleType(name, "Stands in for a package that is not installed.")
        sys.modules[full].wigner_D_matrix = _raise


def _forget(package: str) -> None:
    """Remove the modules of a package from those that are imported; blocked ones (None) remain."""
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        if sys.modules[name] is not None:
            del sys.modules[name]


def _raise(*_: Any, **__: Any) -> None:
    raise MissingPackageError(
        "escnn's representations of SO(3) need lie_learn and NumPy 1", "pip install lie_learn"
    )
