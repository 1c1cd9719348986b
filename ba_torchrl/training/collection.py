"""Collection of a run's data: environments, collectors and demonstrations."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ba_torchrl import make_vector_env
from ba_torchrl.algorithms.base import Learner, SeedUse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations.collect import collect_demonstrations, source_config
from ba_torchrl.demonstrations.demo_files import load_demonstrations
from ba_torchrl.demonstrations.episodes import is_success
from ba_torchrl.envs.episode_positions import EpisodePosition
from ba_torchrl.training.collectors.base import Collection, CollectionProblem
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.learner import build_learner

logger = logging.getLogger(__name__)


def make_env(config: ExperimentConfig, seed: int, **changes: Any) -> EnvBase:
    """Return the environments of a run, ready to be reset.

    Args:
        config: of the run.
        seed: of the first environment.
        changes: keywords of `make_vector_env`; by default, failed processes are waited for.
    """
    options = {"seed": seed, "wait_for_restarts": True, **changes}
    return make_vector_env(config.env, config.num_envs, workers=config.workers, **options)


def start_collection(
    config: ExperimentConfig,
    learner: Learner,
    seed: int,
    positions: Sequence[EpisodePosition] | None,
) -> Collection:
    """Start the collector of a run; see `CollectorConfig.start`."""
    # by reference to the classes of this process's main module, which cloudpickle would copy
    pickled = pickle.dumps(config)
    problem = CollectionProblem(
        learner=learner,
        device=config.torch_device,
        num_envs=config.num_envs,
        seed=seed,
        make_env=partial(_make_some_envs, pickled, learner.config.imitates == "expert_everywhere"),
        make_policy=partial(_make_policy, pickled),
        workers=config.workers,
    )
    return config.collector.start(problem, positions)


def _make_some_envs(pickled: bytes, expert: bool, num_envs: int, seed: int) -> EnvBase:
    config: ExperimentConfig = pickle.loads(pickled)
    changes: dict[str, Any] = {"num_envs": num_envs}
    if config.parallel is None and num_envs < config.num_envs:
        changes["parallel"] = False  # the workers are processes already
    config = config.model_copy(update=changes)
    labels = {"expert": expert, "expert_chunk": config.algorithm.expert_chunk}
    return make_env(config, seed, wait_for_restarts=config.wait_for_restarts, **labels)


def _make_policy(pickled: bytes, seed: int) -> TensorDictModuleBase:
    config: ExperimentConfig = pickle.loads(pickled)
    return build_learner(config.model_copy(update={"device": "cpu", "seed": seed})).policy


def gather_demonstrations(
    config: ExperimentConfig,
    learner: Learner,
    on_episode: Callable[[TensorDict], None] | None = None,
) -> list[TensorDict]:
    """Return the episodes [T] of a run's demonstrations, read from a folder or played now.

    Those that are played have actions that the policy of ``learner`` can choose, and are given to
    ``on_episode``. If too few can be used, `ConfigError` is raised.
    """
    if config.demonstrations_path is not None:
        episodes = load_demonstrations(
            config.demonstrations_path,
            task=config.task,
            env=config.env.given,
            mapping=config.demonstrations_mapping,
        )
        for name in ("demonstrations_noise", "demonstrations_turn_noise", "demonstrations_source"):
            if getattr(config, name) != type(config).model_fields[name].default:
                logger.warning("%s has no effect on episodes of demonstrations_path", name)
        if config.only_successful_demonstrations:
            episodes = [episode for episode in episodes if is_success(episode)]
        if len(episodes) < config.demonstrations:
            raise ConfigError(
                f"{len(episodes)} episodes of {config.demonstrations_path} succeed, "
                f"{config.demonstrations} are needed; set demonstrations to a smaller number"
            )
        return episodes[: config.demonstrations]
    seed = config.derived_seed(SeedUse.DEMONSTRATIONS)
    chunk = config.algorithm.expert_chunk
    labels = {**source_config(config.demonstrations_source), "expert_chunk": chunk}
    env = make_env(config, seed, **labels)
    try:
        return collect_demonstrations(
            env,
            config.demonstrations,
            seed=seed,
            source=config.demonstrations_source,
            only_successful=config.only_successful_demonstrations,
            noise=config.demonstrations_noise,
            turn_noise=config.demonstrations_turn_noise,
            turns=config.env.actions.turns,
            primitive=config.env.actions.primitive,
            nearest_action=learner.nearest_action,
            on_episode=on_episode,
        )
    finally:
        env.close()
