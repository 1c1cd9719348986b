"""RLPD by TorchRL's REDQLoss: SAC with an ensemble of critics, half of the data demonstrations.

python recipes/torchrl/rlpd.py --task close_loop/block_reaching

Loss, replay, collector and evaluation are TorchRL's; environments, experts and networks are ours.
The critics are whole networks with layer normalisation. Ball et al. (2023) have ten of them and
twenty updates per step.
"""

import argparse
from functools import partial

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector, Evaluator
from torchrl.data import LazyTensorStorage, OfflineToOnlineReplayBuffer, ReplayBuffer
from torchrl.objectives import REDQLoss, SoftUpdate

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.data import as_transitions
from ba_torchrl.demonstrations import collect_demonstrations
from ba_torchrl.modules import (
    ActionValue,
    ActorCriticSpec,
    EquivariantConfig,
    evaluation_copy,
    squashed_gaussian_policy,
)


def main(
    task: str = "close_loop/block_reaching",
    seed: int = 0,
    steps: int = 300,
    demonstrations: int = 50,
    num_envs: int = 5,
    batch_size: int = 64,
    width: int = 8,
    critics: int = 2,
    updates_per_step: int = 4,
    eval_every: int = 100,
    eval_episodes: int = 50,
) -> float:
    """Train a policy, and return its success rate."""
    torch.manual_seed(seed)
    make = partial(ba_torchrl.make_vector_env, task, num_envs, parallel=False, obs_size=64)
    single = ba_torchrl.make(task, obs_size=64, seed=seed + 10_000)
    images, sequence = dict(single.images), single.actions.sequence
    observation = [*images, keys.HOLDING]

    config = EquivariantConfig(n_hidden=width, depth_center_m=0.2, depth_scale_m=0.1)
    spec = ActorCriticSpec(images, sequence, critics=1)  # one with layer normalisation
    policy = squashed_gaussian_policy(config.build(spec).actor, observation)
    values = [config.build(spec) for _ in range(critics)]
    loss = REDQLoss(
        policy,
        [
            TensorDictModule(
                ActionValue(each.encoder, each.critic),
                [*observation, keys.ACTION],
                ["state_action_value"],
            )
            for each in values
        ],
        num_qvalue_nets=critics,
        sub_sample_len=2,
        alpha_init=0.01,
        min_alpha=1e-4,
        target_entropy=-float(len(sequence)),
        deactivate_vmap=True,  # a loop is faster on a CPU
    )
    loss.make_value_estimator(gamma=0.95)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    target_updater = SoftUpdate(loss, tau=0.05)

    offline = ReplayBuffer(storage=LazyTensorStorage(100 * demonstrations))
    for episode in collect_demonstrations(make(seed=seed + 20_000, expert=True), demonstrations):
        offline.extend(as_transitions(episode, images, is_demonstration=True))
    replay = OfflineToOnlineReplayBuffer(
        offline, online_capacity=num_envs * steps, offline_fraction=0.5, batch_size=batch_size
    )
    evaluator = Evaluator(
        single,  # of environments that step together, short episodes would count more
        policy,
        num_trajectories=eval_episodes,
        frames_per_batch=single.max_steps,
        collector_kwargs={"traj_format": "cat", "auto_register_policy_transforms": False},
    )
    collector = Collector(
        make(seed=seed),
        evaluation_copy(policy),  # with the same parameters
        frames_per_batch=num_envs,
        total_frames=num_envs * steps,
        auto_register_policy_transforms=False,
    )
    for step, data in enumerate(collector, start=1):
        replay.extend(as_transitions(data, images, is_demonstration=False))
        for _ in range(updates_per_step):
            losses = loss(replay.sample())
            optimizer.zero_grad()
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            optimizer.step()
            target_updater.step()
        if step % eval_every == 0 or step == steps:
            rate = evaluator.evaluate()["eval/reward"]
            print(f"step {step}: success_rate {rate:.2f} over {eval_episodes} episodes")
    collector.shutdown()
    evaluator.shutdown()
    return rate


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="close_loop/block_reaching")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=300)
    main(**vars(parser.parse_args()))
