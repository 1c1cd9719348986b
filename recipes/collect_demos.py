"""Collect demonstrations from a task's expert or by deconstruction of structures, and save them.

python recipes/collect_demos.py task=close_loop/block_picking episodes=100 path=demos/picking
python recipes/collect_demos.py task=open_loop/house_building_4 source=deconstruction
python recipes/collect_demos.py task=open_loop/house_building_4 source=deconstruction replays=200
"""

from typing import Any

import hydra
from pydantic import Field, field_validator

from ba_torchrl import make_vector_env
from ba_torchrl.config import StrictModel
from ba_torchrl.data.demo_files import save_demonstrations
from ba_torchrl.data.demos import (
    Source,
    check_noise,
    check_turn_noise,
    collect_demonstrations,
    source_config,
)
from ba_torchrl.data.episodes import mean_length, success_rate
from ba_torchrl.data.time_reversal import replay_scores
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.errors import ConfigError
from ba_torchrl.record.logging import progress_bar
from ba_torchrl.training.command_line import (
    Count,
    NewPath,
    NumEnvs,
    Plugins,
    Seed,
    TaskId,
    command,
    register_schemas,
    without,
)

register_schemas()


class Settings(StrictModel):
    """Settings of this command."""

    plugins: Plugins
    task: TaskId
    env: dict[str, Any]
    path: NewPath
    source: Source
    episodes: Count
    replays: int = Field(ge=0)
    only_successful: bool
    noise: float = Field(ge=0, lt=1)
    turn_noise: float = Field(ge=0, lt=1)
    num_envs: NumEnvs
    parallel: bool | None
    seed: Seed

    @field_validator("env")
    @classmethod
    def _check_env(cls, env: dict[str, Any]) -> dict[str, Any]:
        return without(env, seed="set seed", expert="set source")


@hydra.main(config_path="../configs", config_name="collect_demos", version_base="1.3")
@command(Settings)
def main(settings: Settings) -> None:
    """Play the expert's episodes and write them into a folder."""
    actions = resolve_env(settings.task, settings.env).actions
    check_noise(settings.noise, settings.source, "noise")
    check_turn_noise(settings.turn_noise, settings.source, actions.turns, "turn_noise")
    env = make_vector_env(
        settings.task,
        settings.num_envs,
        parallel=settings.parallel,
        register_modules=settings.plugins,
        **{**settings.env, "seed": settings.seed, **source_config(settings.source)},
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
        env=settings.env,
        seed=settings.seed,
        source=settings.source,
    )
    print(
        f"{len(episodes)} episodes of {settings.task}, success {success_rate(episodes):.2f}, "
        f"{mean_length(episodes):.1f} steps each, in {settings.path}"
    )
    if settings.replays and settings.source == "deconstruction":
        scores = replay_scores(settings.task, settings.replays, seed=settings.seed, **settings.env)
        print(
            f"of {settings.replays} structures taken apart {scores.reversible:.3f} can be "
            f"reversed; played in the simulator, {scores.success_rate:.3f} of these reach the goal"
        )


if __name__ == "__main__":
    main()
