"""The default collector: the policy runs in the learner's process."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import Collector

from ba_torchrl.core import keys
from ba_torchrl.envs.episode_positions import EpisodePosition
from ba_torchrl.training.collectors.base import Collection, CollectionProblem
from ba_torchrl.training.collectors.single_config import SingleConfig
from ba_torchrl.training.interruption import positions_of


def start(
    _: SingleConfig, problem: CollectionProblem, positions: Sequence[EpisodePosition] | None
) -> SingleCollection:
    """Start to collect; see `CollectorConfig.start`."""
    return SingleCollection(problem, positions)


class SingleCollection(Collection):
    """Steps of all environments together, [num_envs] transitions each.

    Args:
        problem: the run's environments and policy.
        positions: from which the environments continue; None to start new episodes.
    """

    def __init__(
        self, problem: CollectionProblem, positions: Sequence[EpisodePosition] | None
    ) -> None:
        super().__init__()
        generators = GlobalRNGState().state_dict()
        self.env = problem.make_env(problem.num_envs, problem.seed)
        if positions is not None:
            self.env.continue_from(positions)
        self._collector = Collector(
            self.env,
            problem.learner.policy,
            frames_per_batch=problem.num_envs,
            total_frames=-1,
            postproc=lambda data: data.reshape(-1),
            policy_device=problem.device,
            storing_device="cpu",
            auto_register_policy_transforms=False,
        )
        self._steps = iter(self._collector)
        if positions is not None:
            GlobalRNGState().load_state_dict(generators)

    def __next__(self) -> TensorDict:
        data = next(self._steps)
        return data.set(keys.ENV_INDEX, torch.arange(len(data), device="cpu"))

    def get_positions(self) -> list[EpisodePosition] | None:
        """Return the position of each environment; None if one has failed."""
        return positions_of(self.env)

    def close(self) -> None:
        """Close the environments."""
        self._collector.shutdown(close_env=False)
        if not self.env.is_closed:
            self.env.close()
