"""robomimic: behaviour cloning by its own training script, validated on ``mask/valid``.

pip install robomimic==0.3.0
ba-torchrl collect task=close_loop/block_reaching episodes=50 env.obs_type=vec path=demos/reaching
ba-torchrl convert demos/reaching format=hdf5 path=exports/reaching.hdf5
python recipes/clients/robomimic_bc.py exports/reaching.hdf5 --epochs 8
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch
from played import played
from robomimic.config import config_factory
from robomimic.scripts.train import train
from robomimic.utils.file_utils import policy_from_checkpoint

parser = argparse.ArgumentParser()
parser.add_argument("file", help="of ba-torchrl convert format=hdf5")
parser.add_argument("--epochs", type=int, default=8)
options = parser.parse_args()

config = config_factory("bc")
with config.values_unlocked():
    config.train.data = options.file
    config.train.output_dir = tempfile.mkdtemp()
    config.train.num_epochs = options.epochs
    config.train.batch_size = 8  # no more than the steps of the validation
    config.train.hdf5_filter_key, config.train.hdf5_validation_filter_key = "train", "valid"
    config.train.seed = 0
    config.observation.modalities.obs.low_dim = ["observation", "holding"]
    config.algo.actor_layer_dims = [256, 256]
    config.algo.optim_params.policy.learning_rate.initial = 1e-3
    config.experiment.validate = True
    config.experiment.rollout.enabled = False  # its rollouts need the old gym
    config.experiment.save.every_n_epochs = options.epochs
    config.experiment.save.on_best_validation = False
    config.experiment.logging.terminal_output_to_txt = False
    config.experiment.logging.log_tb = False
train(config, torch.device("cpu"))
checkpoint = next(Path(config.train.output_dir).rglob("*.pth"))
policy, _ = policy_from_checkpoint(ckpt_path=str(checkpoint), device=torch.device("cpu"))
ENV = "BulletArm/CloseLoopBlockReaching-v0"
played(policy, ENV, reset=policy.start_episode, obs_type="vec")
