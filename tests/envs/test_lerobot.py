"""What policies of LeRobot see of a task, by the rules of LeRobot's readers, without LeRobot."""

import gymnasium
import numpy as np
import pytest

from ba_torchrl.core.errors import UnknownNameError
from ba_torchrl.envs.lerobot import LeRobotEnv

PICKING, STACKING = "close_loop/block_picking", "close_loop/block_stacking"
CAMERAS = {"obs_size": 64, "rgb": True, "camera_size": 32, "observations": ["wrist_rgb"]}
POSES = {"obs_type": "vec", "observations": ["proprio", "joints"]}


def check_features(features):
    """Check what LeRobot asks of features, and its policies of what they are trained on."""
    assert features.keys() >= {"action", "observation.state"}
    shapes = set()
    for name, feature in features.items():
        assert "/" not in name
        assert isinstance(feature["shape"], tuple)
        assert len(feature["names"]) == len(set(feature["names"]))
        if feature["dtype"] == "image":
            assert name.startswith("observation.images.")
            assert feature["names"][0] == "channels"
            shapes.add(feature["shape"])
        else:
            assert feature["dtype"] == "float32"  # normalised, so no bool
            assert feature["shape"] == (len(feature["names"]),) > (1,)  # which would be a scalar
        assert feature["info"]["frame"]
    assert len(shapes) <= 1  # Diffusion Policy
    assert all(shape[0] == 3 for shape in shapes)  # ACT
    assert shapes or "observation.environment_state" in features


@pytest.mark.parametrize(
    ("task", "config", "cameras", "pictures", "state"),
    [
        (PICKING, {"obs_size": 64}, None, ["depth"], ["holding", "empty"]),
        (PICKING, CAMERAS, None, ["rgb", "rgb_depth", "wrist_rgb"], ["holding", "empty"]),
        (PICKING, CAMERAS, ["wrist_rgb"], ["wrist_rgb"], ["holding", "empty"]),
        ("open_loop/block_stacking", {"obs_size": 96}, None, ["heightmap"], ["holding", "empty"]),
        (STACKING, POSES, None, [], ["x", "qw", "opening", "tool_yaw", "joint 6", "holding"]),
    ],
)
def test_policies_see_pictures_of_one_size_and_named_numbers(
    task, config, cameras, pictures, state
):
    env = LeRobotEnv(task, config, cameras)
    features = env.view.features
    check_features(features)
    assert [name.removeprefix("observation.images.") for name in features if "images" in name] == (
        pictures
    )
    assert set(state) <= set(features["observation.state"]["names"])
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    if config is POSES:
        assert features["observation.environment_state"]["names"][:2] == [
            "object_0_x",
            "object_0_y",
        ]
        poses = env.unwrapped.torchrl_env.reset(seed=0)["observation"]
        np.testing.assert_array_equal(env.reset(seed=0)[0]["environment_state"], poses[5:])
    first = "primitive" if task.startswith("open") else "gripper"
    assert features["action"]["names"][:3] == [first, "x", "y"]
    env.close()


def test_depth_is_a_picture_of_three_equal_channels():
    env = LeRobotEnv(PICKING, {"obs_size": 64})
    picture = env.reset(seed=0)[0]["pixels"]["depth"]
    depth = env.unwrapped.torchrl_env.reset(seed=0)["depth"].numpy()
    info = env.view.features["observation.images.depth"]["info"]
    assert (picture == picture[..., :1]).all()
    found = info["of_0"] + picture[..., 0] / 255 * (info["of_255"] - info["of_0"])
    np.testing.assert_allclose(found, depth[0], atol=0.51 * info["of_255"] / 255)
    env.close()


def test_a_camera_that_is_not_there_is_named():
    with pytest.raises(UnknownNameError, match=r"unknown camera 'wrist'\. Known: depth"):
        LeRobotEnv(PICKING, {"obs_size": 64}, ["wrist"])


# One process: each imports the package.
@pytest.mark.parametrize("kind", ["SyncVectorEnv", "AsyncVectorEnv"])
def test_the_contract_of_lerobots_environments(kind):
    count = 2 if kind == "SyncVectorEnv" else 1
    makers = [lambda: LeRobotEnv(PICKING, {"obs_size": 64, "max_steps": 2})] * count
    vector = getattr(gymnasium.vector, kind)(makers)
    try:
        assert vector.call("task") == (PICKING,) * count
        assert vector.call("task_description") == (PICKING,) * count
        assert vector.call("_max_episode_steps") == (2,) * count
        assert [spec.max_episode_steps for spec in vector.get_attr("spec")] == [2] * count
        observation, _ = vector.reset(seed=[*range(count)], options={"lerobot_new_rollout": True})
        assert vector.call("task_description") == ("pick up the red block",) * count
        assert vector.observation_space.contains(observation)
        assert observation["agent_pos"].tolist() == [[0, 1]] * count
        for _ in range(2):
            _, _, _, truncated, info = vector.step(np.full((count, 5), 1.5))  # clipped
        assert truncated.all()
        assert info["is_success"].tolist() == [False] * count
    finally:
        vector.close()


def test_a_finished_environment_shows_its_last_picture_and_renders_no_other():
    env = LeRobotEnv(PICKING, {"obs_size": 64, "max_steps": 1})
    env.reset(seed=0)
    env.step(np.zeros(5, np.float32))
    last = env.render()
    assert last.std() > 1
    env.env.render = None  # would raise
    assert env.render() is last
    del env.env.render
    env.reset(seed=1)
    assert (env.render() != last).any()
    env.close()
