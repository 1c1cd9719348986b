"""Collection of a run's data: environments, collectors and demonstrations."""

from __future__ import annotations

import logging
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
    return make_vector_env(config.resolved_env, config.num_envs, workers=config.workers, **options)


def start_collection(
    config: ExperimentConfig,
    learner: Learner,
    seed: int,
    positions: Sequence[EpisodePosition] | None,
) -> Collection:
    """Start the collector of a run; see `CollectorConfig.start`."""
    values = config.model_dump(mode="json")  # which other processes read, plugins first
    problem = CollectionProblem(
        learner=learner,
        device=config.torch_device,
        num_envs=config.num_envs,
        seed=seed,
        make_env=partial(_make_some_envs, values, learner.config.imitates == "expert_everywhere"),
        make_policy=partial(_make_policy, values),
        workers=config.workers,
    )
    return config.collector.start(problem, positions)


def _make_some_envs(values: dict[str, Any], expert: bool, num_envs: int, seed: int) -> EnvBase:
    shared_with_other_workers = num_envs < values["num_envs"]
    if values["parallel"] is None and shared_with_other_workers:
        values = {**values, "parallel": False}  # the workers are processes already
    config = _read(values, num_envs=num_envs)
    labels = {"expert": expert, "expert_chunk": config.algorithm.expert_chunk}
    return make_env(config, seed, wait_for_restarts=config.wait_for_restarts, **labels)


def _make_policy(values: dict[str, Any], seed: int) -> TensorDictModuleBase:
    return build_learner(_read(values, device="cpu", seed=seed)).policy


def _read(values: dict[str, Any], **changes: int | str) -> ExperimentConfig:
    return ExperimentConfig.model_validate({**values, **changes})


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
            env=config.env,
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
            turns=config.resolved_env.actions.turns,
            primitive=config.resolved_env.actions.primitive,
            nearest_action=learner.nearest_action,
            on_episode=on_episode,
        )
    finally:
        env.close()
