"""TorchRL's transforms of images, vectors, rewards, counts and actions; slow in open loop."""

import contextlib

import pytest
import torch
from torchrl.envs import GymEnv, TransformedEnv, transforms as tr
from torchrl.envs.utils import check_env_specs
from torchrl.record import PixelRenderTransform

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.data import CenterCrop, ImageCodecs, RandomViews
from tests.specs import slow_except

TASKS = {"close_loop/block_reaching": {}, "open_loop/block_stacking": {"num_objects": 2}}
CASES = slow_except(list(TASKS), ["close_loop/block_reaching"])

OF_IMAGES = {
    "CenterCrop of ours": lambda key: CenterCrop(9, [key], ["centre"]),
    "CatFrames": lambda key: tr.CatFrames(3, dim=-3, in_keys=[key]),
    "DTypeCastTransform": lambda key: tr.DTypeCastTransform(
        torch.float32, torch.float64, in_keys=[key, "reward"]
    ),
    "FlattenObservation": lambda key: tr.FlattenObservation(-3, -1, in_keys=[key]),
    "GrayScale": lambda key: tr.Compose(
        tr.ToTensorImage(in_keys=["rgb"], shape_tolerant=True), tr.GrayScale(in_keys=["rgb"])
    ),
    "ObservationNorm": lambda key: tr.ObservationNorm(0.1, 2.0, in_keys=[key]),
    "RenameTransform": lambda key: tr.RenameTransform([key], ["image"]),
    "VecNormV2": lambda key: tr.VecNormV2(in_keys=[key]),
}
OF_VECTORS = {
    "CatTensors": lambda: tr.CatTensors(
        in_keys=["observation", "expert_action"], out_key="both", del_keys=False
    ),
    "ObservationNorm": lambda: tr.ObservationNorm(0.1, 2.0, in_keys=["observation"]),
}
OF_REWARDS = {
    "RewardClipping": lambda: tr.RewardClipping(-0.5, 0.5),
    "RewardScaling": lambda: tr.RewardScaling(loc=-1.0, scale=10.0),
    "RewardScaling, normal": lambda: tr.RewardScaling(0.5, 2.0, standard_normal=True),
    "RewardSum": lambda: tr.RewardSum(),
    "TargetReturn": lambda: tr.TargetReturn(1.0),
}
OF_COUNTS_AND_ACTIONS = {
    "ActionDiscretizer": lambda: tr.ActionDiscretizer(3),
    "ActionScaling": lambda: tr.ActionScaling(),
    "FrameSkipTransform": lambda: tr.FrameSkipTransform(2),
    "InitTracker": lambda: tr.InitTracker(),
    "MultiAction": lambda: tr.MultiAction(),
    "NoopResetEnv": lambda: tr.NoopResetEnv(2),
    "StepCounter": lambda: tr.StepCounter(max_steps=2),
    "StepCounter, other key": lambda: tr.StepCounter(max_steps=2, step_count_key="count"),
    "TrajCounter": lambda: tr.TrajCounter(),
}


@contextlib.contextmanager
def made(task, **config):
    env = ba_torchrl.make(task, seed=0, max_steps=5, expert=True, **TASKS[task], **config)
    yield env
    env.close()


@pytest.fixture(scope="module", params=CASES)
def pixel_env(request):
    with made(request.param, obs_size=16, rgb=True) as env:
        yield env


@pytest.fixture(scope="module", params=CASES)
def vector_env(request):
    with made(request.param, obs_type="vec") as env:
        yield env


def check(env, transform):
    transformed = TransformedEnv(env, transform)
    check_env_specs(transformed, break_when_any_done="both", seed=0)
    return transformed


@pytest.mark.parametrize("name", OF_IMAGES)
def test_images_can_be_transformed(pixel_env, name):
    check(pixel_env, OF_IMAGES[name](next(iter(pixel_env.images))))


def test_a_codec_gives_the_images_of_the_replay(pixel_env):
    codec = ImageCodecs(pixel_env.images)
    env = check(pixel_env, codec)
    key = next(iter(pixel_env.images))
    exact, seen = pixel_env.reset(seed=1), env.reset(seed=1)
    stored = codec.codecs[key].decode(codec.codecs[key].encode(exact[key]))
    assert torch.equal(seen[key], stored)
    assert not torch.equal(seen[key], exact[key])
    assert torch.equal(seen["rgb"], exact["rgb"])
    assert torch.equal(codec(seen.clone())[key], stored)  # no further change


def test_a_transform_of_transitions_is_refused_by_name(pixel_env):
    env = TransformedEnv(pixel_env, RandomViews(pixel_env.images, seed=0))
    with pytest.raises(ConfigError, match=r"RandomViews .*: append it to a replay"):
        env.reset()


def test_rendered_pixels_leave_the_image_of_the_control_alone(pixel_env):
    key = next(iter(pixel_env.images))
    expected = pixel_env.reset(seed=1)[key]
    state = TransformedEnv(pixel_env, PixelRenderTransform()).reset(seed=1)
    assert torch.equal(state[key], expected)
    assert (state["pixels"].shape, state["pixels"].dtype) == ((360, 480, 3), torch.uint8)


def test_pixels_of_gymnasium_are_beside_the_depth_and_become_a_tensor_image():
    name = "BulletArm/CloseLoopBlockReaching-v0"
    env = GymEnv(name, from_pixels=True, pixels_only=False, obs_size=16)
    env = TransformedEnv(env, tr.ToTensorImage(["pixels"]))
    seen = env.base_env.reset()
    assert (seen["pixels"].shape, seen["pixels"].dtype) == ((360, 480, 3), torch.uint8)
    state = env.rollout(1)["next"][0]
    assert state["depth"].shape == (1, 16, 16)
    assert (state["pixels"].shape, state["pixels"].dtype) == ((3, 360, 480), torch.float32)
    assert 0.5 < state["pixels"].max() <= 1
    env.close()


@pytest.mark.parametrize("name", OF_VECTORS)
def test_vectors_can_be_transformed(vector_env, name):
    check(vector_env, OF_VECTORS[name]())


@pytest.mark.parametrize("name", OF_REWARDS)
def test_rewards_can_be_transformed(pixel_env, name):
    check(pixel_env, OF_REWARDS[name]())


@pytest.mark.parametrize("name", OF_COUNTS_AND_ACTIONS)
def test_counts_and_actions_can_be_transformed(pixel_env, name):
    check(pixel_env, OF_COUNTS_AND_ACTIONS[name]())


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("RewardClipping", (0.0, 0.5)),
        ("RewardScaling", (-1.0, 9.0)),
        ("RewardScaling, normal", (-0.25, 0.25)),
    ],
)
def test_a_transformed_reward_has_the_values_of_its_formula(pixel_env, name, expected):
    env = check(pixel_env, OF_REWARDS[name]())
    pixel_env.set_seed(0)
    episode = env.rollout(5, lambda td: td.set(keys.ACTION, td[keys.EXPERT_ACTION]))
    assert episode["next", keys.SUCCESS][-1]
    rewards = episode["next", keys.REWARD].flatten().tolist()
    assert rewards == pytest.approx([expected[0]] * (len(rewards) - 1) + [expected[1]])
