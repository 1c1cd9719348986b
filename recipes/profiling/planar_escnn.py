"""escnn's layers for planar groups, which are measured and compared with the package's.

``pip install --no-deps escnn==1.0.11 joblib`` installs what they need. escnn also imports
`lie_learn`, whose wheels need NumPy 1, and `py3nj`, which needs a Fortran compiler; both serve
rotations in space only.
"""

import sys
import warnings
from types import ModuleType

_NAMES = ("lie_learn", "representations", "SO3", "wigner_d")
for _end in range(len(_NAMES)):
    _name = ".".join(_NAMES[: _end + 1])
    sys.modules.setdefault(_name, ModuleType(_name, "Stands in for a package that is not used."))
sys.modules[_name].wigner_D_matrix = None

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", message=".*py3nj")
    from escnn import gspaces, nn

__all__ = ["gspaces", "nn"]
