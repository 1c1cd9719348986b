"""escnn without its dependencies for rotations in space."""

import subprocess
import sys

CODE = """
import sys
for name in ("lie_learn", "py3nj"):
    sys.modules[name] = None  # not installed
import warnings
warnings.simplefilter("error")
from ba_torchrl.errors import MissingPackageError
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


def test_planar_groups_work_and_rotations_in_space_name_what_they_need():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
