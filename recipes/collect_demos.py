"""Collect demonstrations from a task's expert or by deconstruction of structures, and save them.

python recipes/collect_demos.py task=close_loop/block_picking episodes=100 path=demos/picking
python recipes/collect_demos.py task=open_loop/house_building_4 source=deconstruction
python recipes/collect_demos.py task=open_loop/house_building_4 source=deconstruction replays=200
"""

import os

import hydra
from omegaconf import DictConfig

from ba_torchrl import make_vector_env
from ba_torchrl.data.demo_files import save_demonstrations
from ba_torchrl.data.demos import (
    check_noise,
    check_turn_noise,
    collect_demonstrations,
    source_config,
)
from ba_torchrl.data.episodes import mean_length, success_rate
from ba_torchrl.data.time_reversal import replay_scores
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.envs.vector.make import MAX_ENVS
from ba_torchrl.errors import ConfigError
from ba_torchrl.plugins import load_plugins
from ba_torchrl.record.logging import limit_library_logs, progress_bar
from ba_torchrl.training.command_line import (
    check_counts,
    check_flags,
    check_known,
    check_seed,
    check_texts,
    check_writable_file,
    env_of,
    plain_errors,
    register_schemas,
)

register_schemas()


@hydra.main(config_path="../configs", config_name="collect_demos", version_base="1.3")
@plain_errors
def main(settings: DictConfig) -> None:
    """Play the expert's episodes and write them into a folder."""
    limit_library_logs()
    check_known(settings)
    load_plugins(settings.plugins)
    check_texts(settings, "task", "path", "source")
    check_counts(settings, "episodes")
    check_counts(settings, "num_envs", most=MAX_ENVS)
    check_counts(settings, "replays", least=0)
    check_seed(settings)
    check_noise(settings.noise, settings.source, "noise")
    check_flags(settings, "only_successful")
    check_flags(settings, "parallel", optional=True)
    if os.path.exists(settings.path):
        raise ConfigError(f"{settings.path} exists already; choose another path")
    check_writable_file(settings.path)
    env_settings = env_of(settings, seed="seed", expert="source")
    actions = resolve_env(settings.task, env_settings).actions
    check_turn_noise(settings.turn_noise, settings.source, actions.turns, "turn_noise")
    env = make_vector_env(
        settings.task,
        settings.num_envs,
        parallel=settings.parallel,
        register_modules=settings.plugins,
        **{**env_settings, "seed": settings.seed, **source_config(settings.source)},
    )
    try:
        with progress_bar(total=settings.episodes, unit="episode") as bar:
            episodes = collect_demonstrations(
                env,
                settings.episodes,
                seed=settings.seed,
                source=settings.source,
                only_successful=settings.only_successful,
                noise=settings.noise,
                turn_noise=settings.turn_noise,
                turns=actions.turns,
                primitive=actions.primitive,
                on_episode=lambda _: bar.update(),
            )
    finally:
        env.close()
    if not episodes:
        raise ConfigError(f"none of {settings.episodes} episodes of {settings.task} can be used")
    save_demonstrations(
        settings.path,
        episodes,
        task=settings.task,
        env=env_settings,
        seed=settings.seed,
        source=settings.source,
    )
    print(
        f"{len(episodes)} episodes of {settings.task}, success {success_rate(episodes):.2f}, "
        f"{mean_length(episodes):.1f} steps each, in {settings.path}"
    )
    if settings.replays and settings.source == "deconstruction":
        scores = replay_scores(settings.task, settings.replays, seed=settings.seed, **env_settings)
        print(
            f"of {settings.replays} structures taken apart {scores.reversible:.3f} can be "
            f"reversed; played in the simulator, {scores.success_rate:.3f} of these reach the goal"
        )


if __name__ == "__main__":
    main()
