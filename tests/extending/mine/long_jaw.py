"""A robot: the UR5 with a parallel jaw whose fingers are 2 cm longer."""

import tempfile
from pathlib import Path

from ba_torchrl.sim.robots import ur5
from ba_torchrl.sim.robots.base import ROBOTS

MODELS = Path(ur5.__file__).parent / "models"
FOLDER = Path(tempfile.mkdtemp())
(FOLDER / "unit_box.obj").write_bytes((MODELS / "unit_box.obj").read_bytes())
model = (MODELS / "parallel_jaw.urdf").read_text()
model = model.replace("0.019 0.066", "0.019 0.086")  # lengths of the fingers
model = model.replace("0 0.047", "0 0.057")  # their centres
(FOLDER / "long_jaw.urdf").write_text(model)


@ROBOTS.register("mine/long_jaw")
class LongJaw(ur5.UR5ParallelJaw):
    """UR5 with longer fingers."""

    gripper_model = str(FOLDER / "long_jaw.urdf")
    tool_offset_m = (0.0, 0.0, 0.1613)  # between the fingertips, in the frame of the hand link
