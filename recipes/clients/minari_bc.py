"""Minari: behaviour cloning in plain PyTorch of a data set that its library loads.

pip install minari==0.5.4
ba-torchrl collect task=close_loop/block_reaching episodes=50 env.obs_type=vec path=demos/reaching
ba-torchrl convert demos/reaching format=minari path=exports/minari/reaching-v0
MINARI_DATASETS_PATH=exports/minari python recipes/clients/minari_bc.py reaching-v0 --steps 1000
"""

from __future__ import annotations

import argparse

import minari
import numpy as np
import torch
from gymnasium import spaces
from played import played
from torch import nn

import ba_torchrl  # noqa: F401 -- the environment of the data set

parser = argparse.ArgumentParser()
parser.add_argument("id", help="of ba-torchrl convert format=minari")
parser.add_argument("--steps", type=int, default=1000)
options = parser.parse_args()

torch.manual_seed(0)
dataset = minari.load_dataset(options.id)
rows, actions = [], []
for episode in dataset.iterate_episodes():
    states = [episode.observations[key] for key in sorted(episode.observations)]
    rows.append(np.concatenate(states, axis=1)[:-1])
    actions.append(episode.actions)
states, actions = (torch.from_numpy(np.concatenate(part)) for part in (rows, actions))
policy = nn.Sequential(nn.Linear(states.shape[1], 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU())
policy.append(nn.Linear(256, actions.shape[1]))
optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)
for _ in range(options.steps):
    batch = torch.randint(len(states), (64,))
    loss = nn.functional.mse_loss(policy(states[batch]), actions[batch])
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


@torch.no_grad()
def act(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Return the action of the network."""
    return policy(torch.from_numpy(spaces.flatten(dataset.observation_space, observation))).numpy()


spec = dataset.recover_environment().spec
played(act, spec.id, **{key: value for key, value in spec.kwargs.items() if key != "task"})
