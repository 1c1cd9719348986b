"""Stable-Baselines3 and sb3-contrib: SAC or TQC learns to reach a block from its state.

pip install stable-baselines3==2.9.2 sb3-contrib==2.9.2
python recipes/clients/sb3.py sac
"""

from __future__ import annotations

import argparse
import importlib

import gymnasium
from played import played

ALGORITHMS = {"sac": ("stable_baselines3", "SAC"), "tqc": ("sb3_contrib", "TQC")}
parser = argparse.ArgumentParser()
parser.add_argument("algorithm", choices=ALGORITHMS)
parser.add_argument("--steps", type=int, default=6000)
parser.add_argument("--seed", type=int, default=0)
options = parser.parse_args()

ENV = "BulletArm/CloseLoopBlockReaching-State-v0"
VALUES = {"action_sequence": "pxyz", "random_orientation": False}  # without yaw
env = gymnasium.make(ENV, reward="difference", reward_discount=0.95, seed=options.seed, **VALUES)
module, name = ALGORITHMS[options.algorithm]
agent = getattr(importlib.import_module(module), name)(
    "MlpPolicy",
    env,
    gamma=0.95,
    learning_rate=1e-3,
    tau=0.02,
    ent_coef="auto_0.1",
    target_entropy=-2.0,
    seed=options.seed,
).learn(options.steps)
played(lambda state: agent.predict(state, deterministic=True)[0], ENV, **VALUES)
