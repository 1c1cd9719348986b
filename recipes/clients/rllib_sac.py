"""RLlib: SAC learns to reach a block from its state.

pip install "ray[rllib]==2.60.0"
python recipes/clients/rllib_sac.py --steps 2000
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from played import played
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.core.columns import Columns
from ray.tune.registry import register_env

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=2000)
options = parser.parse_args()
ENV = "BulletArm/CloseLoopBlockReaching-State-v0"
VALUES = {"action_sequence": "pxyz", "random_orientation": False}  # without yaw
REWARD = {"reward": "difference", "reward_discount": 0.95}
NETWORKS = {"fcnet_hiddens": [128, 128], "fcnet_activation": "relu"}
NETWORKS |= {"fusionnet_hiddens": [128], "fusionnet_activation": "relu"}  # of the critics
# in Ray's processes nobody has imported the package: "ba_torchrl:" makes Gymnasium do it
register_env("reaching", lambda config: gymnasium.make(f"ba_torchrl:{ENV}", **config))
config = (
    SACConfig()
    .environment("reaching", env_config={**REWARD, **VALUES})
    .env_runners(num_env_runners=0)
    .rl_module(model_config=NETWORKS)
    .training(
        gamma=0.95,
        tau=0.02,
        train_batch_size_per_learner=64,
        **{f"{part}_lr": 1e-3 for part in ("actor", "critic", "alpha")},
        initial_alpha=0.01,
        target_entropy=-2.0,
        num_steps_sampled_before_learning_starts=500,
        replay_buffer_config={"type": "EpisodeReplayBuffer", "capacity": 10_000},
    )
    .debugging(seed=0)
)
algorithm = config.build_algo()
steps = 0
while steps < options.steps:
    steps = algorithm.train()["env_runners"]["num_env_steps_sampled_lifetime"]
module = algorithm.get_module()


@torch.no_grad()
def act(state: object) -> object:
    """Return the mean action."""
    out = module.forward_inference({Columns.OBS: torch.as_tensor(state)[None]})
    # its own deterministic action lacks the tanh of the sampled ones
    return torch.tanh(out["action_dist_inputs"].chunk(2, -1)[0]).numpy()


played(act, ENV, **VALUES)
