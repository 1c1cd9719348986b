"""The network takes any batch shape, and trains."""

import pytest
import torch
from my_network import MyNetworkConfig

from ba_torchrl.core.images import ImageSpec
from ba_torchrl.modules.base import ActorCriticSpec
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.experiment import Experiment

SPEC = ActorCriticSpec({"depth": ImageSpec(1, 32, 0.5)}, "pxyzr", vectors={"proprio": 8})


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_any_batch_shape(batch):
    actor, encoder, critic = MyNetworkConfig(width=4, vector_keys=("proprio",)).build(SPEC)
    observation = (
        torch.rand(*batch, 1, 32, 32),
        torch.ones(*batch, 1, dtype=torch.bool),
        torch.rand(*batch, 8),
    )
    loc, scale = actor(*observation)
    assert loc.shape == scale.shape == (*batch, 5)
    assert (scale > 0).all()
    assert critic(encoder(*observation), loc.tanh()).shape == (*batch, 2)


def test_training(tmp_path):
    values = {
        "task": "close_loop/block_reaching",
        "env": {"obs_size": 32},
        "algorithm": {"name": "sac", "batch_size": 8},
        "network": {"name": "mine/my_network", "width": 4},
        "run_dir": str(tmp_path / "run"),
    }
    small = {"num_envs": 2, "parallel": False, "demonstrations": 2, "min_replay": 1}
    small |= {"total_updates": 4, "eval_every": 4, "eval_episodes": 2, "final_eval_episodes": 2}
    config = ExperimentConfig.parse({**values, **small, "video_episodes": 0})
    assert Experiment(config, progress=False).run().updates == 4
