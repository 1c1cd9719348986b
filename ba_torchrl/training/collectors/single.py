"""The default collector: the policy runs in the learner's process."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
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
        carried = [each[keys.CARRIED] for each in positions or () if keys.CARRIED in each]
        self._carried = torch.stack([TensorDict(each) for each in carried]) if carried else None
        """What the policy carried out of the last step of each environment, if anything."""
        self._collector = Collector(
            self.env,
            _Continuing(problem.learner.policy, self._carried),
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
        self._carried = data.get(keys.CARRIED, None)
        return data.set(keys.ENV_INDEX, torch.arange(len(data), device="cpu"))

    def get_positions(self) -> list[EpisodePosition] | None:
        """Return the position of each environment, with what the policy carries to its next step;
        None if one has failed."""
        positions = positions_of(self.env)
        if positions is None or self._carried is None:
            return positions
        pairs = zip(positions, self._carried.clone(), strict=True)
        return [{**position, keys.CARRIED: each.to_dict()} for position, each in pairs]

    def close(self) -> None:
        self._collector.shutdown(close_env=False)
        if not self.env.is_closed:
            self.env.close()


class _Continuing(TensorDictModuleBase):
    """A policy, which gets in its first call what it carried to this step before.

    TorchRL's collector calls it once more at the start, to see what it writes.

    Args:
        policy: acts on a root TensorDict [num_envs].
        carried: entries [num_envs]; None for none.
    """

    def __init__(self, policy: TensorDictModuleBase, carried: TensorDictBase | None) -> None:
        super().__init__()
        self.policy, self._carried = policy, carried
        self.in_keys, self.out_keys = list(policy.in_keys), list(policy.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._carried is not None and keys.CARRIED not in tensordict:
            tensordict.set(keys.CARRIED, self._carried.to(tensordict.device))
        return self.policy(tensordict)
