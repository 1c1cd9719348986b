"""Show a task: the expert or random actions, in a video or in a window.

python recipes/play.py task=open_loop/covid_test video=covid_test.mp4
python recipes/play.py task=close_loop/block_pushing policy=random episodes=3
python recipes/play.py task=close_loop/corner_picking video=null env.render=true   # needs a display
"""

import hydra
import torch
from omegaconf import DictConfig

from ba_torchrl.data.demos import expert_policy
from ba_torchrl.errors import ConfigError
from ba_torchrl.plugins import load_plugins
from ba_torchrl.record.logging import limit_library_logs
from ba_torchrl.record.video import check_video, write_video
from ba_torchrl.training.command_line import (
    check_counts,
    check_known,
    check_seed,
    check_texts,
    check_writable_file,
    env_of,
    plain_errors,
    register_schemas,
)
from ba_torchrl.training.evaluation import record_episodes

POLICIES = {"expert": expert_policy, "random": None}

register_schemas()


@hydra.main(config_path="../configs", config_name="play", version_base="1.3")
@plain_errors
def main(settings: DictConfig) -> None:
    """Play episodes and write a video of them."""
    limit_library_logs()
    check_known(settings)
    load_plugins(settings.plugins)
    check_texts(settings, "task", "policy")
    check_texts(settings, "video", optional=True)
    if settings.policy not in POLICIES:
        raise ConfigError(f"policy: {settings.policy!r} is none of {', '.join(POLICIES)}")
    check_counts(settings, "episodes")
    check_seed(settings)
    if settings.video is not None:
        check_video(settings.video, settings.fps)
        check_writable_file(settings.video)
    env = env_of(settings, seed="seed", expert="policy")
    torch.manual_seed(settings.seed)
    frames = record_episodes(
        settings.task,
        {**env, "expert": settings.policy == "expert"},
        POLICIES[settings.policy],
        settings.episodes,
        settings.seed,
    )
    print(f"{settings.episodes} episodes of {settings.task}, {len(frames)} pictures")
    if settings.video is not None:
        print(f"  video  {write_video(settings.video, frames, fps=settings.fps)}")


if __name__ == "__main__":
    main()
