"""Tianshou: SAC learns to reach a block from its state.

pip install tianshou==2.0.1
python recipes/clients/tianshou_sac.py --steps 4000
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
import torch
from played import played
from tianshou.algorithm.modelfree.sac import SAC, AutoAlpha, SACPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, CollectStats, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=4000)
options = parser.parse_args()
torch.manual_seed(0)
np.random.seed(0)  # noqa: NPY002 -- the library draws from it
ENV = "BulletArm/CloseLoopBlockReaching-State-v0"
VALUES = {"action_sequence": "pxyz", "random_orientation": False}  # without yaw
REWARD = {"reward": "difference", "reward_discount": 0.95}
envs = DummyVectorEnv([lambda: gymnasium.make(ENV, seed=0, **REWARD, **VALUES)])
state, action = envs.observation_space[0].shape, envs.action_space[0].shape
optimizer = AdamOptimizerFactory(lr=1e-3)
shapes = {"state_shape": state, "hidden_sizes": [128, 128]}
actor = ContinuousActorProbabilistic(
    preprocess_net=Net(**shapes), action_shape=action, unbounded=True, conditioned_sigma=True
)
critics = [
    ContinuousCritic(preprocess_net=Net(**shapes, action_shape=action, concat=True))
    for _ in range(2)
]
algorithm = SAC(
    policy=SACPolicy(actor=actor, action_space=envs.action_space[0]),
    policy_optim=optimizer,
    critic=critics[0],
    critic_optim=optimizer,
    critic2=critics[1],
    critic2_optim=optimizer,
    tau=0.02,
    gamma=0.95,
    alpha=AutoAlpha(-2.0, float(np.log(0.1)), optimizer),
)
buffer = VectorReplayBuffer(10_000, 1)
collector = Collector[CollectStats](algorithm, envs, buffer, exploration_noise=True)
collector.reset()
collector.collect(n_step=500, random=True)
sizes = {"epoch_num_steps": options.steps, "collection_step_num_env_steps": 1, "batch_size": 128}
algorithm.run_training(OffPolicyTrainerParams(training_collector=collector, max_epochs=1, **sizes))
algorithm.policy.eval()
played(lambda state: algorithm.policy.compute_action(state), ENV, **VALUES)
