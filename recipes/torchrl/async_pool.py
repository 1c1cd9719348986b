"""Demonstrations from TorchRL's AsyncEnvPool: no environment waits for the steps of another one.

python recipes/torchrl/async_pool.py --task open_loop/house_building_2 --num-envs 4

The time of an open-loop step varies with the path of the arm and the search for feasible grasps.
The policy acts for those environments that have answered. Each plays the same number of episodes,
so that short ones do not count more and the same seed gives the same data.
"""

import argparse
from functools import partial

import torch
from tensordict import TensorDict
from torchrl.envs import AsyncEnvPool

import ba_torchrl
from ba_torchrl.core import keys
from ba_torchrl.data import as_transitions, make_codecs, make_replay
from ba_torchrl.demonstrations import expert_policy, success_rate


def main(
    task: str = "open_loop/block_stacking",
    seed: int = 0,
    num_envs: int = 2,
    episodes_per_env: int = 10,
    obs_size: int = 64,
    backend: str = "multiprocessing",
    batch_size: int = 16,
) -> TensorDict:
    """Collect demonstrations into a replay, and return a batch of it."""
    single = ba_torchrl.make(task, obs_size=obs_size)
    images = dict(single.images)
    single.close()
    makers = [
        partial(ba_torchrl.make, task, obs_size=obs_size, seed=seed + i, expert=True)
        for i in range(num_envs)
    ]
    pool = AsyncEnvPool(makers, backend=backend, exchange="auto")
    steps: list[list[TensorDict]] = [[] for _ in makers]
    episodes: list[list[TensorDict]] = [[] for _ in makers]
    try:
        pool.async_reset_send(env_index=list(range(num_envs)))
        state = pool.async_reset_recv(min_get=num_envs)
        pool.async_step_and_maybe_reset_send(expert_policy(state))
        while any(len(played) < episodes_per_env for played in episodes):
            data, state = pool.async_step_and_maybe_reset_recv(min_get=1)
            unfinished = []
            for row, i in enumerate(data[keys.ENV_INDEX]):
                steps[i].append(data[row].exclude(keys.ENV_INDEX).clone())
                if data[row][keys.NEXT, keys.DONE]:
                    episodes[i].append(torch.stack(steps[i]))
                    steps[i] = []
                if len(episodes[i]) < episodes_per_env:
                    unfinished.append(row)
            if unfinished:
                pool.async_step_and_maybe_reset_send(expert_policy(state[unfinished]))
    finally:
        pool.close()

    ordered = [episode for played in episodes for episode in played]
    replay = make_replay("uniform", 100_000, batch_size, codecs=make_codecs(images), seed=seed)
    for episode in ordered:
        replay.extend(as_transitions(episode, images, is_demonstration=True))
    print(f"{len(replay)} transitions, success_rate {success_rate(ordered):.2f}")
    return replay.sample()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="open_loop/block_stacking")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--num-envs", type=int, default=2)
    parser.add_argument("--episodes-per-env", type=int, default=10)
    main(**vars(parser.parse_args()))
