"""skrl: SAC learns to reach a block from its state.

pip install "skrl[torch]==2.1.1"
python recipes/clients/skrl_sac.py --steps 6000
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
import torch
from played import played
from skrl.agents.torch.sac import SAC
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=6000)
options = parser.parse_args()
set_seed(0)
ENV = "BulletArm/CloseLoopBlockReaching-State-v0"
VALUES = {"action_sequence": "pxyz", "random_orientation": False}  # without yaw
env = gymnasium.make(ENV, reward="difference", reward_discount=0.95, seed=0, **VALUES)
env = wrap_env(env)
spaces = {"observation_space": env.observation_space, "action_space": env.action_space}

hidden = {"name": "net", "layers": [128, 128], "activations": "relu"}
policy = gaussian_model(
    **spaces,
    clip_actions=True,
    initial_log_std=-1.0,
    network=[{**hidden, "input": "OBSERVATIONS"}],
    output="tanh(ACTIONS)",
)
both = [{**hidden, "input": "concatenate([OBSERVATIONS, ACTIONS])"}]
names = ("critic_1", "critic_2", "target_critic_1", "target_critic_2")
critics = {name: deterministic_model(**spaces, network=both, output="ONE") for name in names}
models = {"policy": policy, **critics}
cfg = {"batch_size": 128, "discount_factor": 0.95, "polyak": 0.02, "target_entropy": -2.0}
cfg |= {"random_timesteps": 500, "learning_starts": 500, "initial_entropy_value": 0.1}
memory = RandomMemory(memory_size=10_000)
agent = SAC(models=models, memory=memory, cfg=cfg, **spaces)
trainer = {"timesteps": options.steps, "headless": True, "close_environment_at_exit": False}
SequentialTrainer(env=env, agents=agent, cfg=trainer).train()
policy.eval()


@torch.no_grad()
def act(state: np.ndarray) -> np.ndarray:
    """Return the mean action."""
    inputs = {"observations": torch.from_numpy(state)[None]}
    return policy.act(inputs, role="policy")[1]["mean_actions"].numpy()


played(act, ENV, **VALUES)
