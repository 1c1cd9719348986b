"""SDQfD in open loop: spatial Q-learning from demonstrations, with TorchRL's collector.

python recipes/torchrl/sdqfd.py --task open_loop/block_stacking

An action is a pick or a place, chosen level by level: the pixel, then the angle. The greedy policy
collects. Half of each batch are demonstrations. Hyper-parameters are those of the open-loop quick
start.
"""

import argparse
from functools import partial

import torch
from torchrl.collectors import Collector, Evaluator
from torchrl.envs import TransformedEnv
from torchrl.objectives import HardUpdate

import ba_torchrl
from ba_torchrl.data import ImageCodecs, as_transitions, make_codecs, make_replay
from ba_torchrl.demonstrations import collect_demonstrations
from ba_torchrl.modules import (
    EquiASRConfig,
    SpatialActions,
    SpatialPolicy,
    SpatialSpec,
    SpatialValues,
    evaluation_copy,
    spatial_policy,
)
from ba_torchrl.objectives import LevelDQNLoss, with_buffer_updates


def main(
    task: str = "open_loop/block_stacking",
    seed: int = 0,
    updates: int = 600,
    num_objects: int = 3,
    demonstrations: int = 50,
    pretrain_updates: int = 300,
    num_envs: int = 5,
    batch_size: int = 16,
    width: float = 0.25,
    num_rotations: int = 8,
    eval_every: int = 150,
    eval_episodes: int = 50,
) -> float:
    """Train a policy, first on the demonstrations alone, and return its success rate."""
    torch.manual_seed(seed)
    settings = {"obs_size": 64, "num_objects": num_objects}
    make = partial(ba_torchrl.make_vector_env, task, num_envs, parallel=False, **settings)
    single = ba_torchrl.make(task, seed=seed + 10_000, **settings)
    images, actions = dict(single.images), single.actions
    single = TransformedEnv(single, ImageCodecs(images))  # images as the replay returns them

    spec = SpatialSpec(
        images,
        components=tuple(name for name in actions.components if name != "p"),
        half_rotation=actions.half_rotation,
        side_m=actions.bounds_m[0][1] - actions.bounds_m[0][0],
    )
    config = EquiASRConfig(width=width, num_rotations=num_rotations, height_scale_m=0.05)
    network = config.build(spec)
    grid = SpatialActions(actions, network.levels, network.limits)
    values = SpatialValues(network, grid, list(images))
    policy = spatial_policy(SpatialPolicy(values, seed))
    loss = LevelDQNLoss(values, demonstrations="sdqfd", demonstration_weight=0.1, margin=0.1)
    loss.make_value_estimator(gamma=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4, weight_decay=1e-5)
    # copies at every 25th update
    target_updater = with_buffer_updates(HardUpdate(loss, value_network_update_interval=24))

    replay = make_replay("symmetric", 100_000, batch_size, codecs=make_codecs(images), seed=seed)
    for episode in collect_demonstrations(
        make(seed=seed + 20_000, expert=True),
        demonstrations,
        only_successful=True,
        nearest_action=grid.nearest,  # the expert executes actions on the network's grid
    ):
        replay.extend(as_transitions(episode, images, is_demonstration=True))

    def update() -> None:
        losses = loss(replay.sample())
        optimizer.zero_grad()
        (losses["loss_qvalue"] + losses["loss_demonstration"]).backward()
        torch.nn.utils.clip_grad_value_(loss.parameters(), 1.0)
        optimizer.step()
        target_updater.step()

    for _ in range(pretrain_updates):
        update()
    evaluator = Evaluator(
        single,  # of environments that step together, short episodes would count more
        policy,
        num_trajectories=eval_episodes,
        frames_per_batch=single.max_steps,
        collector_kwargs={"traj_format": "cat", "auto_register_policy_transforms": False},
    )
    collector = Collector(
        TransformedEnv(make(seed=seed), ImageCodecs(images)),
        evaluation_copy(policy),  # with the same parameters
        frames_per_batch=num_envs,
        total_frames=num_envs * (updates - pretrain_updates),
        auto_register_policy_transforms=False,
    )
    for count, data in enumerate(collector, start=pretrain_updates + 1):
        replay.extend(as_transitions(data, images, is_demonstration=False))
        update()
        if count % eval_every == 0 or count == updates:
            rate = evaluator.evaluate()["eval/reward"]
            print(f"update {count}: success_rate {rate:.2f} over {eval_episodes} episodes")
    collector.shutdown()
    evaluator.shutdown()
    return rate


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="open_loop/block_stacking")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--updates", type=int, default=600)
    main(**vars(parser.parse_args()))
