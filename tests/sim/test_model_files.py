import shutil
import subprocess

import pybullet
import pytest

from ba_torchrl.core.errors import SimulationError
from ba_torchrl.sim.world import loading
from tests.fresh import run_script


def load(path, client):
    with loading(path):
        return pybullet.loadURDF(str(path), physicsClientId=client)


@pytest.fixture
def client():
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(client)


def test_a_model_that_cannot_be_loaded_is_named(tmp_path, client):
    path = tmp_path / "robot.urdf"
    with pytest.raises(FileNotFoundError, match=r"robot\.urdf"):
        load(path, client)
    path.write_text("no model", encoding="utf-8")
    with pytest.raises(SimulationError, match=r"PyBullet cannot load .*robot\.urdf"):
        load(path, client)
    path = tmp_path / "other.urdf"  # PyBullet keeps the content of a file
    path.write_text("<robot name='cube'><link name='body'/></robot>", encoding="utf-8")
    assert load(path, client) == 0


UNDER_A_DECIMAL_COMMA = """
import ctypes, locale, multiprocessing, os, threading
from concurrent.futures import ThreadPoolExecutor

import pybullet

from ba_torchrl.sim.meshes import box_mesh, transform_mesh
from ba_torchrl.sim.robots import base, kuka, panda, ur5
from ba_torchrl.sim.shapes import Solid
from ba_torchrl.sim.world import World, decimal_point

os.environ["LOCPATH"] = "."


def separator():
    return locale.localeconv()["decimal_point"]


def models(start=None):
    found = []
    for name in base.ROBOTS:
        with World() as world:
            if start:
                start.wait()
            robot = base.ROBOTS[name](world)
            boxes = [transform_mesh(box_mesh((0.1, 0.1, 0.1)), (x, 0.0, 0.0)) for x in (0.0, 0.15)]
            body = world.add(Solid(parts=tuple(boxes)), "boxes")
            found += [
                pybullet.getJointInfo(robot.id, joint, world.client)[8:]
                for joint in robot.arm_joints
            ]
            found += [pybullet.getAABB(body.id, -1, world.client)]
    return found


expected = models()
locale.setlocale(locale.LC_NUMERIC, "comma.UTF-8")  # in a spawned process as well
if __name__ == "__main__":
    assert separator() == ","
    assert models() == expected
    start = threading.Barrier(2)
    with ThreadPoolExecutor(2) as threads:
        assert list(threads.map(models, [start, start])) == [expected, expected]
        with World() as world, decimal_point(world.client):
            with decimal_point(world.client):
                assert separator() == "."
            assert separator() == "."
            assert threads.submit(separator).result() == ","
    for method in ("fork", "spawn"):
        with multiprocessing.get_context(method).Pool(1) as pool:
            assert pool.apply(models) == expected, method
            assert pool.apply(separator) == ","
    ctypes.CDLL = lambda _: None  # threads have no locale of their own
    assert models() == expected
    assert separator() == ","
    assert locale.setlocale(locale.LC_NUMERIC) == "comma.UTF-8"
"""


def test_models_are_read_with_a_decimal_point_under_any_locale(tmp_path):
    command = ["localedef", "-i", "de_DE", "-f", "UTF-8", str(tmp_path / "comma.UTF-8")]
    if not shutil.which("localedef") or subprocess.run(command, check=False).returncode:
        pytest.skip("localedef cannot make a locale with a decimal comma")
    run_script(tmp_path, UNDER_A_DECIMAL_COMMA)
