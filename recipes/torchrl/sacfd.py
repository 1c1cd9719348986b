"""SACfD in one file: Soft Actor-Critic from demonstrations (appendix F), with TorchRL's parts.

python recipes/torchrl/sacfd.py
python recipes/torchrl/sacfd.py task=close_loop/drawer_opening network=equi total_updates=3000

The replay is prioritised, with a bonus for demonstrations (appendix G.2, "PER"). Sampled
transitions are rotated, which the appendix does not do. ``recipes/train.py`` has more options,
checkpoints, resumption, curves and videos.
"""

from dataclasses import dataclass

import numpy as np
import torch
import tqdm
from omegaconf import OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

import ba_torchrl
from ba_torchrl._malloc import tune_malloc
from ba_torchrl.algorithms.acting import ActingPolicy
from ba_torchrl.data.augmentation.so2 import SO2Augmentation
from ba_torchrl.data.demos import collect_demonstrations
from ba_torchrl.data.episodes import collect_episodes, success_rate
from ba_torchrl.data.replay.buffer import FrameReplayBuffer
from ba_torchrl.data.replay.codecs import make_codecs
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.envs import keys
from ba_torchrl.modules.actor_critic.cnn import CNNConfig
from ba_torchrl.modules.actor_critic.equivariant import EquivariantConfig
from ba_torchrl.modules.actor_critic.gaussian_policy import squashed_gaussian_policy
from ba_torchrl.modules.base import ActorCritic, ActorCriticSpec
from ba_torchrl.objectives.sacfd import SACfDLoss

OBSERVATION = [keys.PIXELS, keys.HOLDING]


@dataclass
class Config:
    """A run of minutes; every field can be set on the command line as ``name=value``."""

    task: str = "close_loop/block_picking"
    obs_size: int = 64  # appendix: 128
    network: str = "equi"  # or "cnn"
    width: int = 16  # regular fields of the equivariant network; of 128 channels of the CNN
    num_envs: int = 5
    parallel: bool = False
    demonstrations: int = 50
    pretrain_updates: int = 200
    total_updates: int = 1500
    batch_size: int = 64
    buffer_size: int = 100_000
    learning_rate: float = 3e-4  # appendix: 1e-3
    gamma: float = 0.95  # appendix: 0.99
    tau: float = 0.05  # reference implementation: 0.01
    demonstration_weight: float = 5.0  # reference implementation: 1
    rotation_probability: float = 0.8  # not in the appendix
    eval_every: int = 250
    eval_episodes: int = 50
    final_eval_episodes: int = 100
    seed: int = 0
    device: str = "cuda" if torch.cuda.is_available() else "cpu"


def make_environment(config: Config, seed: int, expert: bool = False) -> EnvBase:
    """Return environments that step together; with ``expert`` they observe its action."""
    return ba_torchrl.make_vector_env(
        config.task,
        config.num_envs,
        parallel=config.parallel,
        obs_size=config.obs_size,
        seed=seed,
        expert=expert,
    )


def make_replay_buffer(config: Config, codecs: dict, seed: int) -> FrameReplayBuffer:
    """Return a prioritised replay, which keeps each frame once, compressed."""
    return make_replay(
        "prioritized", config.buffer_size, config.batch_size, codecs=codecs, seed=seed
    )


def make_networks(config: Config, images: dict, sequence: str) -> ActorCritic:
    """Return actor, encoder and twin critics."""
    depth = {"depth_center_m": 0.2, "depth_scale_m": 0.1}  # inputs of unit size
    if config.network == "equi":
        network = EquivariantConfig(n_hidden=config.width, **depth)
    else:
        network = CNNConfig(width=config.width / 128, **depth)
    networks = network.build(ActorCriticSpec(images, sequence))
    return ActorCritic(*(module.to(config.device) for module in networks))


def make_loss(config: Config, networks: ActorCritic) -> SACfDLoss:
    """Return the loss of actor, critics and entropy temperature."""
    critic_inputs = ["critic_features", keys.ACTION]
    loss = SACfDLoss(
        squashed_gaussian_policy(networks.actor, OBSERVATION),
        TensorDictModule(networks.encoder, OBSERVATION, ["critic_features"]),
        TensorDictModule(networks.critic, critic_inputs, ["state_action_value"]),
        demonstration_weight=config.demonstration_weight,
        demonstration_distance="kl",  # reference implementation: the squared error
        entropy_backup=False,  # as in the quick start; reference implementation: true
        weight_norm="max",  # Schaul et al., 2016; TorchRL's losses: "mean"
    )
    return loss.make_value_estimator(gamma=config.gamma).to(config.device)


def demonstrate(config: Config, seed: int) -> list[TensorDict]:
    """Return episodes of the expert."""
    env = make_environment(config, seed, expert=True)
    episodes = collect_demonstrations(env, config.demonstrations, seed=seed)
    env.close()
    return episodes


def evaluate(config: Config, env: EnvBase, policy: ActingPolicy, episodes: int, seed: int) -> float:
    """Return the success rate of the greedy policy."""

    def act(state: TensorDictBase) -> TensorDictBase:
        seen = state.select(*policy.in_keys).to(config.device)
        return state.set(keys.ACTION, policy(seen)[keys.ACTION].cpu())

    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return success_rate(collect_episodes(env, act, episodes, seed=seed, results_only=True))


def main(config: Config) -> float:
    """Train, and return the success rate of the last policy."""
    torch.manual_seed(config.seed)
    seeds = np.random.SeedSequence(config.seed).generate_state(6).tolist()
    demo_seed, train_seed, eval_seed, report_seed, replay_seed, rotation_seed = seeds
    single = ba_torchrl.make(config.task, obs_size=config.obs_size)
    images, sequence = {keys.PIXELS: single.images[keys.PIXELS]}, single.actions.sequence
    single.close()
    codecs = make_codecs(images)

    networks = make_networks(config, images, sequence)
    loss = make_loss(config, networks)
    actor = squashed_gaussian_policy(networks.actor, OBSERVATION)
    policy = ActingPolicy(actor, codecs).to(config.device)  # acts on images as they are stored
    replay = make_replay_buffer(config, codecs, replay_seed)
    rotate = SO2Augmentation(
        images, sequence, seed=rotation_seed, probability=config.rotation_probability
    )
    optimizer = torch.optim.Adam(loss.parameters(), lr=config.learning_rate)
    target_updater = SoftUpdate(loss, tau=config.tau)
    bar = tqdm.tqdm(total=config.total_updates, unit="update")

    def update() -> None:
        replay.sampler.anneal(bar.n / config.total_updates)
        batch = rotate(replay.sample().to(config.device))
        losses = loss(batch)
        optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        optimizer.step()
        target_updater.step()
        replay.update_tensordict_priority(batch.select("index", keys.TD_ERROR).cpu())
        bar.update()
        if bar.n % config.eval_every == 0 and bar.n < config.total_updates:
            rate = evaluate(config, eval_env, policy, config.eval_episodes, eval_seed)
            bar.set_postfix(success=f"{rate:.2f}", q=f"{losses['q_value'].item():.2f}")

    eval_env = make_environment(config, eval_seed)
    for episode in demonstrate(config, demo_seed):
        replay.extend(as_transitions(episode, images, is_demonstration=True))
    for _ in range(config.pretrain_updates):
        update()
    env = make_environment(config, train_seed)
    collector = Collector(
        env,
        policy,
        frames_per_batch=config.num_envs,
        total_frames=config.num_envs * (config.total_updates - config.pretrain_updates),
        policy_device=config.device,
        storing_device="cpu",
        auto_register_policy_transforms=False,
    )
    for data in collector:
        replay.extend(as_transitions(data, images, is_demonstration=False))
        update()
    collector.shutdown()
    bar.close()
    rate = evaluate(config, eval_env, policy, config.final_eval_episodes, report_seed)
    eval_env.close()
    print(f"success_rate {rate:.2f} over {config.final_eval_episodes} episodes")
    return rate


if __name__ == "__main__":
    tune_malloc()  # halves the time of an update on a CPU
    main(OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Config), OmegaConf.from_cli())))
