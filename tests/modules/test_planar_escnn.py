"""escnn without its dependencies for rotations in space."""

import pytest

from tests.fresh import run_script

CODE = """
import sys
for name in ("lie_learn", "py3nj"):
    sys.modules[name] = None  # not installed
import warnings
warnings.simplefilter("error")
BEFORE
from ba_torchrl.core.errors import MissingPackageError
from ba_torchrl.modules.steerable.planar_escnn import import_escnn
gspaces = import_escnn("escnn.gspaces")
assert gspaces.rot2dOnR2(8).fibergroup.order() == 8
from escnn.group import SO3, so3_group
try:
    so3_group(1).irrep(1)(so3_group(1).sample())
except MissingPackageError as error:
    assert "lie_learn" in str(error), error
else:
    raise SystemExit("rotations in space were computed")
"""


@pytest.mark.parametrize("before", ["", pytest.param("import escnn", marks=pytest.mark.slow)])
def test_planar_groups_work_and_rotations_in_space_name_what_they_need(before, tmp_path):
    run_script(tmp_path, CODE.replace("BEFORE", before))


CACHES_ONLY = """
import sys
from importlib.machinery import ModuleSpec

class Caches:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name == "escnn":  # a folder without modules
            return ModuleSpec(name, None, is_package=True)

sys.meta_path.insert(0, Caches)
from ba_torchrl.cli import main
main(["doctor"])
"""


def test_a_folder_of_caches_is_no_escnn(tmp_path):
    out = run_script(tmp_path, CACHES_ONLY).stdout
    assert "escnn                  the package's own kernels" in out


BESIDE_SCIKIT_LEARN = """
import sys
from types import ModuleType
import numpy as np
from ba_torchrl.modules.steerable.planar_escnn import import_escnn
assert "escnn" not in sys.modules
def refuse(*_, **__):
    raise TypeError("np.matrix is not supported")
for name in ("sklearn", "sklearn.utils", "sklearn.utils.extmath"):
    sys.modules[name] = ModuleType(name)
sys.modules["sklearn.utils.extmath"].randomized_svd = refuse
kernel = import_escnn("escnn.group._numerical").null(np.matrix([[2.0, 0.0], [0.0, 0.0]]), False)
assert np.allclose(np.abs(kernel), [[0.0], [1.0]]), kernel
"""


def test_kernels_are_found_beside_scikit_learn(tmp_path):
    run_script(tmp_path, BESIDE_SCIKIT_LEARN)
