"""Soft Actor-Critic from demonstrations (SACfD) by TorchRL's SACTrainer.

python recipes/torchrl/sacfd.py --task close_loop/block_picking

The loss adds a behaviour term on demonstrations to SAC's. The replay is prioritised, with a bonus
for demonstrations, and sampled transitions are rotated about the vertical. Hyper-parameters are
those of the quick start.
"""

import argparse
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.checkpoint import Checkpoint
from torchrl.collectors import Collector, Evaluator
from torchrl.data.replay_buffers.scheduler import LinearScheduler
from torchrl.envs import TransformedEnv
from torchrl.objectives import SoftUpdate
from torchrl.trainers.algorithms import SACTrainer

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.data import ImageCodecs, SO2Augmentation, as_transitions, make_codecs, make_replay
from ba_torchrl.demonstrations import collect_demonstrations
from ba_torchrl.modules import (
    ActorCriticSpec,
    EquivariantConfig,
    evaluation_copy,
    squashed_gaussian_policy,
)
from ba_torchrl.objectives import SACfDLoss, with_buffer_updates


def main(
    task: str = "close_loop/block_picking",
    seed: int = 0,
    updates: int = 300,
    demonstrations: int = 50,
    num_envs: int = 5,
    batch_size: int = 64,
    width: int = 16,
    eval_every: int = 100,
    eval_episodes: int = 50,
    checkpoint: str | None = None,
) -> float:
    """Train a policy, and return its success rate."""
    torch.manual_seed(seed)
    make = partial(ba_torchrl.make_vector_env, task, num_envs, parallel=False, obs_size=64)
    single = ba_torchrl.make(task, obs_size=64, seed=seed + 10_000)
    images, sequence = dict(single.images), single.actions.sequence
    single = TransformedEnv(single, ImageCodecs(images))  # images as the replay returns them
    observation = [*images, keys.HOLDING]

    config = EquivariantConfig(n_hidden=width, depth_center_m=0.2, depth_scale_m=0.1)
    networks = config.build(ActorCriticSpec(images, sequence))
    policy = squashed_gaussian_policy(networks.actor, observation)
    loss = SACfDLoss(
        policy,
        TensorDictModule(networks.encoder, observation, ["features"]),
        TensorDictModule(networks.critic, ["features", keys.ACTION], ["state_action_value"]),
        demonstration_weight=5.0,
        demonstration_distance="kl",
        entropy_backup=False,
    )
    loss.make_value_estimator(gamma=0.95)

    replay = make_replay("prioritized", 100_000, batch_size, codecs=make_codecs(images), seed=seed)
    for episode in collect_demonstrations(make(seed=seed + 20_000, expert=True), demonstrations):
        replay.extend(as_transitions(episode, images, is_demonstration=True))
    weights = LinearScheduler(replay, "beta", final_value=1.0, num_steps=updates)
    replay.append_transform(SO2Augmentation(images, sequence, seed=seed))

    collector = Collector(
        TransformedEnv(make(seed=seed), ImageCodecs(images)),
        evaluation_copy(policy),  # with the same parameters
        frames_per_batch=num_envs,
        total_frames=num_envs * updates,
        postproc=partial(as_transitions, images=images, is_demonstration=False),
        auto_register_policy_transforms=False,
    )
    trainer = SACTrainer(
        collector=collector,
        total_frames=num_envs * updates,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=3e-4),
        target_net_updater=with_buffer_updates(SoftUpdate(loss, tau=0.05)),
        replay_buffer=replay,
        log_rewards=False,  # would need TorchRL's RewardSum(out_keys=["reward_sum"])
        checkpoint=None if checkpoint is None else Checkpoint(),
        save_trainer_file=checkpoint,
    )
    evaluator = Evaluator(
        single,  # of environments that step together, short episodes would count more
        policy,
        num_trajectories=eval_episodes,
        frames_per_batch=single.max_steps,
        collector_kwargs={"traj_format": "cat", "auto_register_policy_transforms": False},
    )

    rates = []

    def evaluate(data: TensorDictBase) -> None:
        count = trainer.collected_frames // num_envs
        if count % eval_every == 0 or count == updates:
            rates.append(evaluator.evaluate()["eval/reward"])
            print(f"update {count}: success_rate {rates[-1]:.2f} over {eval_episodes} episodes")

    trainer.register_op("post_optim", weights.step)
    trainer.register_op("post_steps_log", evaluate)
    trainer.train()
    evaluator.shutdown()
    return rates[-1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="close_loop/block_picking")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--updates", type=int, default=300)
    parser.add_argument("--checkpoint")
    main(**vars(parser.parse_args()))
