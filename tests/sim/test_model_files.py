import pybullet
import pytest

from ba_torchrl.errors import SimulationError
from ba_torchrl.sim.model_files import loading


def load(path, client):
    with loading(path):
        return pybullet.loadURDF(str(path), physicsClientId=client)


@pytest.fixture
def client():
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(client)


def test_a_model_that_is_missing_is_an_os_error(tmp_path, client):
    with pytest.raises(FileNotFoundError, match=r"robot\.urdf"):
        load(tmp_path / "robot.urdf", client)


def test_a_model_that_pybullet_does_not_load_is_named(tmp_path, client):
    path = tmp_path / "robot.urdf"
    path.write_text("no model", encoding="utf-8")
    with pytest.raises(SimulationError, match=r"PyBullet cannot load .*robot\.urdf"):
        load(path, client)


def test_a_model_that_pybullet_loads_is_returned(tmp_path, client):
    path = tmp_path / "robot.urdf"
    path.write_text("<robot name='cube'><link name='body'/></robot>", encoding="utf-8")
    assert load(path, client) == 0
