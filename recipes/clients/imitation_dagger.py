"""imitation: DAgger, whose labels are the expert's, and GAIL on its episodes.

pip install stable-baselines3==2.9.2 datasets huggingface-sb3 rich sacred scikit-learn tensorboard
pip install --no-deps imitation==1.0.1 seals==0.2.1
python recipes/clients/imitation_dagger.py dagger --steps 400
"""

from __future__ import annotations

import argparse
import tempfile

import numpy as np
from imitation.algorithms import bc
from imitation.algorithms.adversarial.gail import GAIL
from imitation.algorithms.dagger import SimpleDAggerTrainer
from imitation.data import rollout
from imitation.data.wrappers import RolloutInfoWrapper
from imitation.rewards.reward_nets import BasicRewardNet
from played import played
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import ba_torchrl  # noqa: F401 -- registers the ids
from ba_torchrl.envs.gym import ExpertPolicy

parser = argparse.ArgumentParser()
parser.add_argument("method", choices=["dagger", "gail"])
parser.add_argument("--steps", type=int, default=400)
options = parser.parse_args()

ENV = "BulletArm/CloseLoopBlockReaching-State-v0"
rng = np.random.default_rng(0)
wrapper = {"wrapper_class": lambda env, **_: RolloutInfoWrapper(env)}
venv = make_vec_env(ENV, 2, seed=0, env_kwargs={"expert": True}, **wrapper)
expert = ExpertPolicy(venv)
if options.method == "dagger":
    spaces = {"observation_space": venv.observation_space, "action_space": venv.action_space}
    trainer = SimpleDAggerTrainer(
        venv=venv,
        scratch_dir=tempfile.mkdtemp(),
        expert_policy=expert,
        bc_trainer=bc.BC(**spaces, rng=rng),
        rng=rng,
    )
    trainer.train(options.steps, rollout_round_min_episodes=3, rollout_round_min_timesteps=50)
    policy = trainer.policy
else:
    shown = rollout.rollout(expert, venv, rollout.make_sample_until(min_episodes=50), rng=rng)
    policy = PPO("MlpPolicy", venv, n_steps=128, batch_size=64, gamma=0.95, seed=0)
    kwargs = {"demo_batch_size": 64, "allow_variable_horizon": True}
    reward = BasicRewardNet(venv.observation_space, venv.action_space)
    GAIL(demonstrations=shown, venv=venv, gen_algo=policy, reward_net=reward, **kwargs).train(
        options.steps
    )
played(lambda state: policy.predict(state, deterministic=True)[0], ENV)
