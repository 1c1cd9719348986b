"""recipes/lerobot_env.py, by the contract of LeRobot's EnvHub and by its loader if it is there."""

import importlib.util
import shutil
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

FILE = Path(__file__).parents[1] / "recipes/lerobot_env.py"
CONFIG = {"obs_size": 64, "rgb": True, "max_steps": 3}


@pytest.fixture
def hub():
    """Load the file as LeRobot does: not as a module that can be imported by its name."""
    spec = importlib.util.spec_from_file_location("hub_env_user_repo", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.TASKS = ("close_loop/block_picking", "close_loop/block_reaching")
    module.ENV = CONFIG
    return module


def close(suites):
    for vectors in suites.values():
        for vector in vectors.values():
            vector.close()


# One process: each imports the package.
@pytest.mark.parametrize(("n_envs", "use_async_envs"), [(2, False), (1, True)])
def test_a_suite_of_vectors(hub, n_envs, use_async_envs):
    hub.TASKS = hub.TASKS[:n_envs]
    suites = hub.make_env(n_envs=n_envs, use_async_envs=use_async_envs)
    try:
        assert list(suites) == ["ba_torchrl"]
        assert list(suites["ba_torchrl"]) == list(range(len(hub.TASKS)))
        vector = suites["ba_torchrl"][0]
        vectors = gymnasium.vector
        kind = vectors.AsyncVectorEnv if use_async_envs else vectors.SyncVectorEnv
        assert isinstance(vector, kind)
        assert vector.num_envs == n_envs
        assert vector.call("task") == ("close_loop/block_picking",) * n_envs
        assert vector.call("task_description") == ("close_loop/block_picking",) * n_envs
        assert vector.call("_max_episode_steps") == (3,) * n_envs
        observation, _ = vector.reset(
            seed=list(range(n_envs)), options={"lerobot_new_rollout": True}
        )
        assert vector.call("task_description") == ("pick up the red block",) * n_envs
        assert vector.observation_space.contains(observation)
        assert observation["images.depth"].shape == (n_envs, 1, 64, 64)
        assert observation["agent_pos"].dtype == np.float32
        rgb = observation["pixels"]["rgb"]
        assert (rgb.shape, rgb.dtype) == ((n_envs, 64, 64, 3), np.uint8)
        assert rgb.std() > 1
        ended = np.zeros(n_envs, bool)
        for _ in range(3):
            _, _, terminated, truncated, info = vector.step(np.full((n_envs, 5), 1.5))
            ended |= terminated | truncated
        assert ended.all()
        assert info["is_success"].tolist() == [False] * n_envs
    finally:
        close(suites)


def test_a_vector_without_environments_is_refused(hub):
    with pytest.raises(ValueError, match="n_envs must be at least 1, not 0"):
        hub.make_env(n_envs=0)


def test_the_configuration_names_the_task(hub):
    suites = hub.make_env(n_envs=1, cfg=SimpleNamespace(task="close_loop/block_reaching"))
    assert suites["ba_torchrl"][0].call("task") == ("close_loop/block_reaching",)
    close(suites)


def test_lerobot_loads_it(tmp_path, monkeypatch):
    utils = pytest.importorskip("lerobot.envs.utils")
    from lerobot.envs.factory import make_env

    file = Path(shutil.copy(FILE, tmp_path / "env.py"))
    monkeypatch.setattr(utils, "hf_hub_download", lambda **_: str(file))  # in place of the network
    suites = make_env("user/repo", n_envs=2, trust_remote_code=True)
    vector = suites["ba_torchrl"][0]
    observation, _ = vector.reset(seed=[0, 1])
    batch = utils.preprocess_observation(observation)
    assert batch["observation.images.depth"].shape == (2, 1, 128, 128)
    assert batch["observation.state"].shape == (2, 1)
    utils.check_env_attributes_and_types(vector)
    close(suites)
