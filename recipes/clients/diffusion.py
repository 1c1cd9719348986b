"""Diffusion Policy's repository: its replay buffer, sampler and U-net learn from a zarr folder.

git clone https://github.com/real-stanford/diffusion_policy
pip install diffusers einops zarr==2.18.3
ba-torchrl collect task=close_loop/block_reaching episodes=50 env.obs_type=vec path=demos/reaching
ba-torchrl convert demos/reaching format=zarr path=exports/reaching.zarr
PYTHONPATH=diffusion_policy python recipes/clients/diffusion.py exports/reaching.zarr
"""

from __future__ import annotations

import argparse

import torch
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusion_policy.common.replay_buffer import ReplayBuffer
from diffusion_policy.common.sampler import SequenceSampler
from diffusion_policy.model.common.normalizer import LinearNormalizer
from diffusion_policy.model.diffusion.conditional_unet1d import ConditionalUnet1D
from diffusion_policy.policy.diffusion_unet_lowdim_policy import DiffusionUnetLowdimPolicy
from played import played

parser = argparse.ArgumentParser()
parser.add_argument("folder", help="of ba-torchrl convert format=zarr")
parser.add_argument("--steps", type=int, default=500)
options = parser.parse_args()
torch.manual_seed(0)
HORIZON = 4
replay = ReplayBuffer.copy_from_path(options.folder, keys=["observation", "action"])
# without the padding, episodes that are shorter than the horizon give no samples
sampler = SequenceSampler(replay, HORIZON, pad_after=HORIZON - 1)
chunks = [sampler.sample_sequence(i) for i in range(len(sampler))]
data = {key: torch.stack([torch.from_numpy(c[key]) for c in chunks]) for key in chunks[0]}
data["obs"] = data.pop("observation")
policy = DiffusionUnetLowdimPolicy(
    ConditionalUnet1D(5, global_cond_dim=9, down_dims=[32, 64]),
    DDPMScheduler(20, beta_schedule="squaredcos_cap_v2", clip_sample=True),
    **{"horizon": HORIZON, "n_action_steps": 1, "n_obs_steps": 1, "obs_dim": 9, "action_dim": 5},
    obs_as_global_cond=True,
    oa_step_convention=True,  # the first action belongs to the observation
)
normalizer = LinearNormalizer()
normalizer.fit(data, mode="limits")
policy.set_normalizer(normalizer)
optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3)
for _ in range(options.steps):
    rows = torch.randint(len(chunks), (64,))
    loss = policy.compute_loss({key: values[rows] for key, values in data.items()})
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

with torch.no_grad():  # the first action of each chunk is played
    played(
        lambda seen: policy.predict_action(
            {"obs": torch.from_numpy(seen["observation"])[None, None]}
        )["action"][0, 0],
        "BulletArm/CloseLoopBlockReaching-v0",
        obs_type="vec",
    )
