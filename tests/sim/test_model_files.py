import pybullet
import pytest

from ba_torchrl.core.errors import SimulationError
from ba_torchrl.sim.world import loading


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
