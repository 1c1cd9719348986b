"""Stable-Baselines3: hindsight replay of goals (HER), with sparse rewards.

pip install stable-baselines3==2.9.2
python recipes/clients/sb3_her.py --steps 10000
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
from played import played
from stable_baselines3 import SAC, HerReplayBuffer

parser = argparse.ArgumentParser()
parser.add_argument("--task", default="Reaching", choices=["Reaching", "Pushing", "Picking"])
parser.add_argument("--steps", type=int, default=10000)
parser.add_argument("--seed", type=int, default=0)
options = parser.parse_args()


class StepCost(gymnasium.RewardWrapper):
    """Rewards -1 and 0, as in Fetch's tasks: the end of an episode costs no later rewards."""

    def reward(self, reward: float) -> float:
        """Return the reward of a step."""
        return reward - 1

    def compute_reward(self, *goals: Any) -> Any:
        """Return the rewards of other goals."""
        return self.env.unwrapped.compute_reward(*goals) - 1


ENV = f"BulletArm/CloseLoopBlock{options.task}-Goal-v0"
agent = SAC(
    "MultiInputPolicy",
    StepCost(gymnasium.make(ENV, seed=options.seed)),
    replay_buffer_class=HerReplayBuffer,
    replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    gamma=0.95,
    learning_rate=1e-3,
    tau=0.02,
    batch_size=256,
    learning_starts=1000,
    ent_coef="auto_0.1",
    target_entropy=-2.0,
    policy_kwargs={"net_arch": [64, 64]},
    seed=options.seed,
).learn(options.steps)
played(lambda observation: agent.predict(observation, deterministic=True)[0], ENV)
