"""Collect demonstrations from a task's expert and save them.

python recipes/collect_demos.py task=close_loop/block_picking episodes=100 path=demos/picking
"""

from pathlib import Path

import hydra
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from ba_torchrl import make_vector_env
from ba_torchrl.config import ConfigError
from ba_torchrl.data.demos import collect_demonstrations, save_demonstrations
from ba_torchrl.data.episodes import mean_length, success_rate
from ba_torchrl.record.logging import quiet_libraries
from ba_torchrl.training import hydra_schema

hydra_schema.register()


@hydra.main(config_path="../configs", config_name="collect_demos", version_base="1.3")
def main(settings: DictConfig) -> None:
    """Let the expert play, and write the episodes as a memory-mapped TensorDict."""
    quiet_libraries()
    if Path(settings.path).exists():
        raise ConfigError(f"{settings.path} exists already; choose another path")
    env_settings = OmegaConf.to_container(settings.env, resolve=True)
    env = make_vector_env(
        settings.task,
        settings.num_envs,
        parallel=settings.parallel,
        **{**env_settings, "seed": settings.seed, "expert": True},
    )
    try:
        with tqdm(total=settings.episodes, unit="episode") as bar:
            episodes = collect_demonstrations(
                env,
                settings.episodes,
                seed=settings.seed,
                only_successful=settings.only_successful,
                on_episode=lambda _: bar.update(),
            )
    finally:
        env.close()
    save_demonstrations(
        settings.path, episodes, task=settings.task, env=env_settings, seed=settings.seed
    )
    print(
        f"{len(episodes)} episodes of {settings.task}, success {success_rate(episodes):.2f}, "
        f"{mean_length(episodes):.1f} steps each, in {settings.path}"
    )


if __name__ == "__main__":
    main()
