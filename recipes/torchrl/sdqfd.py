"""SDQfD in one file: spatial Q-learning from demonstrations (appendix E, G.1) with TorchRL.

python recipes/torchrl/sdqfd.py
python recipes/torchrl/sdqfd.py task=open_loop/house_building_2 num_objects=null network=asr

Every action is a pick or a place, chosen level by level: the pixel, then the angle. The greedy
policy collects. ``recipes/train.py`` has more options, resumption, checkpoints, curves and videos.
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
from torchrl.objectives import HardUpdate

import ba_torchrl
from ba_torchrl._malloc import tune_malloc
from ba_torchrl.actions import OpenLoopActions
from ba_torchrl.algorithms.acting import ActingPolicy
from ba_torchrl.algorithms.spatial_actions import demonstration_on_grid
from ba_torchrl.data.demos import collect_demonstrations
from ba_torchrl.data.episodes import collect_episodes, success_rate
from ba_torchrl.data.replay.buffer import FrameReplayBuffer
from ba_torchrl.data.replay.codecs import make_codecs
from ba_torchrl.data.replay.make import make_replay
from ba_torchrl.data.transitions import as_transitions
from ba_torchrl.envs import keys
from ba_torchrl.modules.spatial.asr import ASRConfig
from ba_torchrl.modules.spatial.base import SpatialSpec
from ba_torchrl.modules.spatial.equi_asr import EquiASRConfig
from ba_torchrl.modules.spatial.policy import SpatialActions, SpatialPolicy, SpatialValues
from ba_torchrl.objectives.dqn import LevelDQNLoss


@dataclass
class Config:
    """A run of minutes; every field can be set on the command line as ``name=value``."""

    task: str = "open_loop/block_stacking"
    num_objects: int | None = 3  # null for the task's number
    obs_size: int = 64  # appendix: 128
    network: str = "equi_asr"  # or "asr"
    width: float = 0.25  # reference implementation: 1
    num_rotations: int = 8  # reference implementation: 16
    num_envs: int = 5
    parallel: bool = False
    demonstrations: int = 50
    pretrain_updates: int = 300
    total_updates: int = 1200
    batch_size: int = 16
    buffer_size: int = 100_000
    learning_rate: float = 3e-4  # appendix: 1e-4
    weight_decay: float = 1e-5
    gradient_clamp: float = 1.0  # reference implementation
    gamma: float = 0.9  # appendix: 0.95
    demonstration_weight: float = 0.1
    margin: float = 0.1
    target_interval: int = 25  # reference implementation: 100
    eval_every: int = 300
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
        num_objects=config.num_objects,
        seed=seed,
        expert=expert,
    )


def make_replay_buffer(config: Config, codecs: dict, seed: int) -> FrameReplayBuffer:
    """Return a replay whose batches are half demonstrations."""
    return make_replay("symmetric", config.buffer_size, config.batch_size, codecs=codecs, seed=seed)


def make_networks(config: Config, images: dict, actions: OpenLoopActions) -> SpatialValues:
    """Return the network, as values of the environment's actions."""
    spec = SpatialSpec(
        images,
        components=tuple(name for name in actions.components if name != "p"),
        half_rotation=actions.half_rotation,
        side_m=actions.bounds_m[0][1] - actions.bounds_m[0][0],
    )
    kind = {"equi_asr": EquiASRConfig, "asr": ASRConfig}[config.network]
    sizes = {"width": config.width, "num_rotations": config.num_rotations}
    network = kind(**sizes, height_scale_m=0.05).build(spec)  # heights in units of the scene
    grid = SpatialActions(actions, network.levels, network.limits)
    return SpatialValues(network, grid, list(images)).to(config.device)


def make_loss(config: Config, values: SpatialValues) -> LevelDQNLoss:
    """Return the TD loss with the margin term on demonstrated actions."""
    terms = {"demonstration_weight": config.demonstration_weight, "margin": config.margin}
    loss = LevelDQNLoss(values, demonstrations="sdqfd", **terms)
    return loss.make_value_estimator(gamma=config.gamma).to(config.device)


def demonstrate(config: Config, grid: SpatialActions, seed: int) -> list[TensorDict]:
    """Return successful episodes of the expert, which executes actions on the network's grid."""
    env = make_environment(config, seed, expert=True)
    settings = {"only_successful": True, "nearest_action": grid.nearest}
    episodes = collect_demonstrations(env, config.demonstrations, seed=seed, **settings)
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
    seeds = np.random.SeedSequence(config.seed).generate_state(5).tolist()
    demo_seed, train_seed, eval_seed, report_seed, replay_seed = seeds
    sizes = {"obs_size": config.obs_size, "num_objects": config.num_objects}
    single = ba_torchrl.make(config.task, **sizes)
    images, actions = dict(single.images), single.actions
    single.close()
    codecs = make_codecs(images)

    values = make_networks(config, images, actions)
    loss = make_loss(config, values)
    greedy = TensorDictModule(SpatialPolicy(values, config.seed), values.in_keys, [keys.ACTION])
    policy = ActingPolicy(greedy, codecs).to(config.device)  # acts on images as they are stored
    replay = make_replay_buffer(config, codecs, replay_seed)
    optimizer = torch.optim.Adam(
        loss.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    # TorchRL copies when its counter exceeds the interval, one update later.
    target_updater = HardUpdate(loss, value_network_update_interval=config.target_interval - 1)
    bar = tqdm.tqdm(total=config.total_updates, unit="update")

    def update() -> None:
        losses = loss(replay.sample().to(config.device))
        optimizer.zero_grad()
        (losses["loss_qvalue"] + losses["loss_demonstration"]).backward()
        torch.nn.utils.clip_grad_value_(loss.parameters(), config.gradient_clamp)
        optimizer.step()
        target_updater.step()
        bar.update()
        if bar.n % config.eval_every == 0 and bar.n < config.total_updates:
            rate = evaluate(config, eval_env, policy, config.eval_episodes, eval_seed)
            bar.set_postfix(success=f"{rate:.2f}", q=f"{losses['q_value'].item():.2f}")

    eval_env = make_environment(config, eval_seed)
    for episode in demonstrate(config, values.actions, demo_seed):
        on_grid = demonstration_on_grid(episode, values.actions, images)
        replay.extend(as_transitions(on_grid, images, is_demonstration=True))
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
