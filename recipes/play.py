"""Show a task: the expert or random actions, in a video or in a window.

python recipes/play.py task=open_loop/covid_test video=covid_test.mp4
python recipes/play.py task=close_loop/block_pushing policy=random episodes=3
python recipes/play.py task=close_loop/corner_picking video=null env.render=true   # needs a display
"""

from typing import Any, Literal

import hydra
import torch
from pydantic import Field, field_validator

from ba_torchrl.config import StrictModel
from ba_torchrl.data.demos import expert_policy
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.record.video import MAX_FPS, MIN_FPS, write_video
from ba_torchrl.training.command_line import (
    Count,
    Plugins,
    Seed,
    TaskId,
    VideoFile,
    command,
    register_schemas,
    without,
)
from ba_torchrl.training.evaluation import record_episodes

register_schemas()


class Settings(StrictModel):
    """Settings of this command."""

    plugins: Plugins
    task: TaskId
    env: dict[str, Any]
    policy: Literal["expert", "random"]
    episodes: Count
    seed: Seed
    video: VideoFile | None
    fps: float = Field(ge=MIN_FPS, le=MAX_FPS)

    @field_validator("env")
    @classmethod
    def _check_env(cls, env: dict[str, Any]) -> dict[str, Any]:
        return without(env, seed="set seed", expert="set policy")


@hydra.main(config_path="../configs", config_name="play", version_base="1.3")
@command(Settings)
def main(settings: Settings) -> None:
    """Play episodes and write a video of them."""
    is_expert = settings.policy == "expert"
    resolved = resolve_env(settings.task, {**settings.env, "expert": is_expert})
    torch.manual_seed(settings.seed)
    policy = expert_policy if is_expert else None
    frames = record_episodes(resolved, policy, settings.episodes, settings.seed)
    print(f"{settings.episodes} episodes of {settings.task}, {len(frames)} pictures")
    if settings.video is not None:
        print(f"  video  {write_video(settings.video, frames, fps=settings.fps)}")


if __name__ == "__main__":
    main()
