"""Collection of a run's data: environments, collector and demonstrations."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from ba_torchrl import make_vector_env
from ba_torchrl.algorithms.base import Algorithm
from ba_torchrl.algorithms.seeds import SeedUse
from ba_torchrl.data.demo_files import load_demonstrations
from ba_torchrl.data.demos import collect_demonstrations, source_config
from ba_torchrl.errors import ConfigError
from ba_torchrl.training.config import ExperimentConfig


def make_env(
    config: ExperimentConfig, seed: int, *, wait_for_restarts: bool = True, **changes: bool
) -> EnvBase:
    """Return the environments of a run, ready to be reset.

    Args:
        config: of the run.
        seed: of the first environment.
        wait_for_restarts: as for `ba_torchrl.make_vector_env`.
        changes: fields of `EnvConfig` that differ from the run's.
    """
    return make_vector_env(
        config.task,
        config.num_envs,
        parallel=config.parallel,
        start_method=config.start_method,
        register_modules=config.plugins,
        timeout_s=config.timeout_s,
        max_restarts=config.max_restarts,
        start_timeout_s=config.start_timeout_s,
        wait_for_restarts=wait_for_restarts,
        **{**config.env, "seed": seed, **changes},
    )


def make_collector(env: EnvBase, algorithm: Algorithm, config: ExperimentConfig) -> Collector:
    """Return a collector of one step of every environment at a time, flattened to [num_envs].

    Args:
        env: the environments, on the CPU.
        algorithm: whose policy explores.
        config: of the run.
    """
    return Collector(
        env,
        algorithm.policy,
        frames_per_batch=config.num_envs,
        total_frames=-1,
        postproc=lambda data: data.reshape(-1),
        policy_device=config.torch_device,
        storing_device="cpu",
        auto_register_policy_transforms=False,
    )


def gather_demonstrations(
    config: ExperimentConfig,
    algorithm: Algorithm,
    on_episode: Callable[[TensorDict], None] | None = None,
) -> list[TensorDict]:
    """Return the episodes [T] of a run's demonstrations, read from a folder or played now.

    Args:
        config: of the run.
        algorithm: whose policy must be able to choose the demonstrated actions.
        on_episode: called with each episode that is played.

    Raises:
        ConfigError: the folder holds fewer than the run asks for.
        RuntimeError: no episode can be used.
    """
    if config.demonstrations_path is not None:
        episodes = load_demonstrations(config.demonstrations_path, task=config.task, env=config.env)
        if len(episodes) < config.demonstrations:
            raise ConfigError(
                f"{config.demonstrations_path} holds {len(episodes)} episodes, fewer than "
                f"demonstrations={config.demonstrations}"
            )
        return episodes[: config.demonstrations]
    seed = config.derived_seed(SeedUse.DEMONSTRATIONS)
    env = make_env(config, seed, **source_config(config.demonstrations_source))
    try:
        episodes = collect_demonstrations(
            env,
            config.demonstrations,
            seed=seed,
            source=config.demonstrations_source,
            only_successful=config.only_successful_demonstrations,
            nearest_action=algorithm.nearest_action,
            on_episode=on_episode,
        )
    finally:
        env.close()
    if not episodes:
        raise RuntimeError(
            f"no episode of the source {config.demonstrations_source!r} can be used; see "
            "demonstrations_source and only_successful_demonstrations"
        )
    return episodes
