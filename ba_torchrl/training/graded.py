"""Graded sets of episodes for offline learning: random, expert, medium and mixed.

The grades are as in D4RL (Fu et al., 2020): uniformly random actions; the expert; a policy whose
training ended at about half success; and equal parts of these three.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any, Literal, get_args

from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ba_torchrl.algorithms.acting import constant_weights
from ba_torchrl.algorithms.base import NETWORKS, Learner, SeedUse, derive_seed
from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import atomic_output
from ba_torchrl.demonstrations.collect import RandomActions
from ba_torchrl.demonstrations.demo_files import (
    check_demonstrations,
    load_demonstrations,
    read_metadata,
    save_demonstrations,
)
from ba_torchrl.demonstrations.episodes import collect_episodes, quotas
from ba_torchrl.envs.factory import make_vector_env
from ba_torchrl.envs.policies import Policy, expert_policy
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.tasks.base import versions_of
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.evaluation import acting_on, evaluate
from ba_torchrl.training.learner import build_learner

logger = logging.getLogger(__name__)

Grade = Literal["random", "expert", "medium", "mixed"]
GRADES: tuple[Grade, ...] = get_args(Grade)
"""In the order in which they are made: medium needs expert, and mixed needs the others."""
SELECTED, ACCEPTED = (0.4, 0.6), (0.3, 0.7)
"""Least and largest success rate at which the training of medium ends, and of a set of it."""
MOST_UPDATES = 2000
_EVERY, _SELECTION_EPISODES = 32, 50
_MEDIUM: dict[str, dict[str, Any]] = {
    "close_loop": {
        "algorithm": {"name": "bc", "batch_size": 32, "optimizer": {"policy_average": 0.95}},
        "network": {
            "name": "cnn",
            "width": 0.5,
            "negative_slope": 0.1,
            "depth_reference": "floor",
            "depth_center_m": 0.2,
            "depth_scale_m": 0.05,
        },
    },
    "open_loop": {
        "algorithm": {"name": "bc", "batch_size": 16, "optimizer": {"policy_average": 0.95}},
        "network": {
            "name": "asr",
            "width": 0.25,
            "dense_width": 0.0625,
            "height_scale_m": 0.05,
        },
    },
}
"""By control of the task, fields of `ExperimentConfig` of the policy of medium."""


@dataclass(frozen=True)
class GradedSets:
    """The sets of a task: ``folder/GRADE``, each an ordinary folder of demonstrations.

    Seeds are derived from `seed` for each grade, so that no episode is one of an evaluation.
    """

    folder: Path
    task: str
    episodes: int
    """Of each set."""
    env: dict[str, Any] = field(default_factory=dict)
    """Fields of `EnvConfig`."""
    seed: int = 0
    num_envs: int = 5
    parallel: bool | None = None
    plugins: Sequence[str] = ()

    def path(self, grade: Grade) -> Path:
        """Return the folder of a set."""
        return self.folder / grade

    def seed_of(self, grade: Grade) -> int:
        """Return the seed of the first episodes of a set; "mixed" begins as "random"."""
        part = 1 + GRADES.index("random" if grade == "mixed" else grade)
        return derive_seed(self.seed, SeedUse.DEMONSTRATIONS, part)

    def make(self, grade: Grade, on_episode: Callable[[TensorDict], None] | None = None) -> bool:
        """Collect a set whose folder does not exist; the folder appears when it is complete.

        Args:
            grade: whose predecessors in `GRADES` exist.
            on_episode: called with each episode that is played.

        Returns:
            Whether there was none.

        Raises:
            ConfigError: the folder holds another set, another process makes it, or no policy has
                half success.
        """
        path = self.path(grade)
        if path.exists():
            self._check(grade)
            return False
        made_by = {
            "random": self._random,
            "expert": self._expert,
            "medium": self._medium,
            "mixed": self._mixed,
        }
        with atomic_output(path) as scratch:
            episodes, policy = made_by[grade](on_episode)
            save_demonstrations(
                scratch,
                episodes,
                task=self.task,
                env=self.env,
                seed=self.seed_of(grade),
                source=grade,
                policy=policy,
            )
        return True

    def _check(self, grade: Grade) -> None:
        path = self.path(grade)
        check_demonstrations(path, task=self.task, env=self.env)
        found = read_metadata(path)
        wanted = {"source": grade, "seed": self.seed_of(grade), "episodes": self.episodes}
        wanted["expert_version"] = versions_of(self.task).expert
        if different := [name for name, value in wanted.items() if found.get(name) != value]:
            raise ConfigError(
                f"{path} holds another set ({', '.join(different)} differ); choose another path"
            )

    def _random(self, on_episode: Any) -> tuple[list[TensorDict], str]:
        primitive = resolve_env(self.task, self.env).actions.primitive
        with_env = self._env(expert=True)
        draw = RandomActions(with_env, 1.0, self.seed_of("random"), primitive=primitive)

        def policy(tensordict: TensorDictBase) -> TensorDictBase:
            return draw(expert_policy(tensordict))

        return self._play(with_env, policy, "random", on_episode), "uniformly random actions"

    def _expert(self, on_episode: Any) -> tuple[list[TensorDict], str]:
        return self._play(self._env(expert=True), expert_policy, "expert", on_episode), "expert"

    def _medium(self, on_episode: Any) -> tuple[list[TensorDict], str]:
        demonstrations = self._read("expert")
        env = self._env()
        try:
            policy, text = half_trained(self, env, demonstrations)
        except BaseException:
            env.close()
            raise
        return self._play(env, policy, "medium", on_episode), text

    def _mixed(self, _: Any) -> tuple[list[TensorDict], str]:
        parts: tuple[Grade, ...] = ("random", "medium", "expert")
        counts = quotas(self.episodes, len(parts))
        sets = [self._read(grade)[:n] for grade, n in zip(parts, counts, strict=True)]
        turns = chain.from_iterable(zip_longest(*sets))
        text = ", ".join(f"{n} {grade}" for grade, n in zip(parts, counts, strict=True))
        return [episode for episode in turns if episode is not None], f"episodes: {text}"

    def _read(self, grade: Grade) -> list[TensorDict]:
        return load_demonstrations(self.path(grade), task=self.task, env=self.env)

    def _env(self, **options: Any) -> EnvBase:
        return make_vector_env(
            self.task,
            self.num_envs,
            parallel=self.parallel,
            register_modules=self.plugins,
            **{**self.env, "seed": self.seed, **options},
        )

    def _play(self, env: EnvBase, policy: Policy, grade: Grade, on_episode: Any) -> list[Any]:
        """Return episodes with the executed actions only; close the environments."""
        try:
            with set_exploration_type(ExplorationType.DETERMINISTIC), constant_weights():
                played = collect_episodes(
                    env, policy, self.episodes, seed=self.seed_of(grade), on_episode=on_episode
                )
        finally:
            env.close()
        others = (*keys.OF_EXPERT, keys.IS_EXPERT, *((keys.NEXT, key) for key in keys.OF_EXPERT))
        return [episode.exclude(*others) for episode in played]


def untrained(sets: GradedSets) -> tuple[ExperimentConfig, Learner]:
    """Return the configuration of medium and its learner before any update.

    Raises:
        ConfigError: the parameters are wrong, or the network does not take the images.
    """
    config = ExperimentConfig.parse(
        {
            "task": sets.task,
            "env": sets.env,
            "seed": sets.seed,
            "plugins": list(sets.plugins),
            "demonstrations": sets.episodes,
            "total_updates": MOST_UPDATES,
            **_MEDIUM[resolve_env(sets.task, sets.env).task_class.control],
        }
    )
    return config, build_learner(config)


def half_trained(
    sets: GradedSets, env: EnvBase, demonstrations: Sequence[TensorDict]
) -> tuple[Policy, str]:
    """Train a policy by behaviour cloning until about half of its episodes succeed.

    It is evaluated at intervals. Where its success rate passes over `SELECTED` within one, the
    interval is trained again in halves.

    Returns:
        The policy, and how it was trained.

    Raises:
        ConfigError: no policy has such a success rate, or as `untrained`.
    """
    config, learner = untrained(sets)
    learner.on_demonstrations(demonstrations)
    policy = acting_on(learner.policy, config.torch_device)
    seed = derive_seed(sets.seed, SeedUse.DEMONSTRATIONS, 1 + len(GRADES))
    least, most = SELECTED
    updates = _EVERY
    while updates and learner.updates < MOST_UPDATES:
        before = copy.deepcopy(learner.state_dict())
        for _ in range(updates):
            learner.update()
        rate = evaluate(env, policy, _SELECTION_EPISODES, seed).success_rate
        logger.info("%s, medium: success %.2f after %d updates", sets.task, rate, learner.updates)
        if least <= rate <= most:
            name = NETWORKS.name_of(type(config.network))
            text = f"bc {name}, {len(demonstrations)} episodes of the expert, "
            text += f"{learner.updates} updates, success {rate:.2f} of {_SELECTION_EPISODES}"
            return policy, text
        if rate > most:
            learner.load_state_dict(before)
            updates //= 2
    raise ConfigError(
        f"medium: no policy of at most {MOST_UPDATES} updates has a success rate from {least} "
        f"to {most}; more episodes or another seed may give one"
    )
