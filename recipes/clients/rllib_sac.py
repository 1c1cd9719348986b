"""RLlib: SAC learns to reach a block from its state.

pip install "ray[rllib]==2.60.0"
python recipes/clients/rllib_sac.py --steps 5000
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
import torch
from played import played
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.core.columns import Columns
from ray.tune.registry import register_env

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=5000)
options = parser.parse_args()

ENV = "BulletArm/CloseLoopBlockReaching-State-v0"
values = {"reward": "difference", "reward_discount": 0.95}
# in Ray's processes nobody has imported the package: "ba_torchrl:" makes Gymnasium do it
register_env("reaching", lambda config: gymnasium.make(f"ba_torchrl:{ENV}", **config))
config = (
    SACConfig()
    .environment("reaching", env_config=values)
    .env_runners(num_env_runners=0)
    .learners(num_learners=0)
    .training(
        gamma=0.95,
        tau=0.02,
        train_batch_size_per_learner=128,
        actor_lr=1e-3,
        critic_lr=1e-3,
        alpha_lr=1e-3,
        initial_alpha=0.1,
        target_entropy=-2.0,
        num_steps_sampled_before_learning_starts=500,
    )
    .debugging(seed=0)
)
algorithm = config.build_algo()
while (algorithm.metrics.peek("num_env_steps_sampled_lifetime", default=0)) < options.steps:
    algorithm.train()
module = algorithm.get_module()


@torch.no_grad()
def act(state: np.ndarray) -> np.ndarray:
    """Return the mean action."""
    out = module.forward_inference({Columns.OBS: torch.from_numpy(state)[None]})
    distribution = module.get_inference_action_dist_cls().from_logits(out["action_dist_inputs"])
    return distribution.to_deterministic().sample().numpy()


played(act, ENV)
