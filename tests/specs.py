"""What networks are built for in the tests, and which cases of a sweep are slow tests."""

import pytest
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement

from ba_torchrl.core.images import ImageSpec
from ba_torchrl.modules.base import ActorCriticSpec
from ba_torchrl.modules.spatial.base import SpatialSpec
from ba_torchrl.sim.robots.base import ROBOTS


def slow_except(values, fast):
    """Return the cases of a sweep, of which all but some are slow tests."""
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)),
            marks=[pytest.mark.slow] * (value not in fast),
        )
        for value in values
    ]


def slow_except_two_robots():
    """Return the names of the robots; of those with other grippers, two are for slow tests."""
    return slow_except(list(ROBOTS), ["kuka", "ur5_robotiq"])


def from_replay(transform, data):
    """Return transitions in their order, sampled from TorchRL's replay with a transform."""
    replay = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(data)), sampler=SamplerWithoutReplacement(shuffle=False)
    )
    replay.append_transform(transform)
    replay.extend(data.clone())
    sampled = replay.sample(len(data))
    assert (replay.storage[:].select(*data.keys(True, True)) == data).all()
    return sampled


def close_loop_images(size=64, high_m=0.39):
    return {"depth": ImageSpec(1, size, high_m, storage="uint8")}


def open_loop_images(size=32, in_hand_size=24, channels=1, high_m=0.24):
    axes = ("yz", "xz", "xy") if channels == 3 else ()
    return {
        "heightmap": ImageSpec(1, size, high_m),
        "in_hand": ImageSpec(channels, in_hand_size, high_m, frame="gripper", channel_axes=axes),
    }


def actor_critic_spec(size=64, sequence="pxyzr"):
    return ActorCriticSpec(close_loop_images(size), sequence)


def spatial_spec(
    size=32, in_hand_size=24, channels=1, components=("x", "y", "rz"), half_rotation=True
):
    return SpatialSpec(open_loop_images(size, in_hand_size, channels), components, half_rotation)
