"""Show a task: the expert, random actions or a trained policy, in a video or in a window.

ba-torchrl play open_loop/covid_test
ba-torchrl play close_loop/block_picking policy=trained
ba-torchrl play close_loop/block_pushing policy=random episodes=3
ba-torchrl play policy=runs/my-run video=my-run.gif
ba-torchrl play close_loop/corner_picking video=null env.render=true   # needs a display
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import ActingSettings, Count, EnvSettings, Fps, TaskId, VideoFile
from ba_torchrl.core.config import LEROBOT, LocalPath
from ba_torchrl.core.errors import ConfigError, UnknownNameError
from ba_torchrl.envs.settings import ResolvedEnv, resolve_env
from ba_torchrl.record.video import write_video

if TYPE_CHECKING:
    from ba_torchrl.envs.policies import Policy
    from ba_torchrl.training.policy import TrainedPolicy


class Settings(EnvSettings, ActingSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {"seed": "set seed", "expert": "set policy"}
    task: TaskId | None = None
    """Id of the task; a policy of a run knows its own."""
    policy: LocalPath = "expert"
    """expert, random, trained (the policy that the package ships), or a run folder, a checkpoint or
    a .safetensors file, or lerobot:FOLDER, a policy that LeRobot trained on an export."""
    episodes: Count = 1
    """Their number."""
    video: VideoFile | None = "play.mp4"
    """A file such as play.mp4 or play.gif, or null."""
    fps: Fps | None = None
    """Frames a second; null for 5 in close loop and 10 in open loop, where frames between the poses
    of a step show the arm move, by interpolation."""


def main(settings: Settings) -> None:
    """Play episodes and write a video of them."""
    resolved, policy = _task_and_policy(settings)
    import torch

    from ba_torchrl.training.evaluation import record_episodes

    torch.manual_seed(settings.seed)
    frames = record_episodes(
        resolved, policy, settings.episodes, settings.seed, on_episode=_print_episode
    )
    print(f"{settings.episodes} episodes of {resolved.task_id}, {len(frames)} pictures")
    if settings.video is not None:
        fps = settings.fps or resolved.video_fps
        print(f"  video  {write_video(settings.video, frames, fps=fps)}")


def _print_episode(number: int, steps: int, is_success: bool) -> None:
    result = "success" if is_success else "failure"
    print(f"episode {number}: {result} after {steps} step{'s' * (steps != 1)}")


def _task_and_policy(settings: Settings) -> tuple[ResolvedEnv, Policy | None]:
    """Return the environment and the policy that acts, None for random actions."""
    is_loaded = settings.policy not in ("expert", "random")
    if settings.task is None and (not is_loaded or settings.policy == "trained"):
        raise ConfigError("task is missing: ba-torchrl play TASK; see --help")
    if settings.algorithm and (not is_loaded or settings.policy.startswith(LEROBOT)):
        raise ConfigError("algorithm is of trained policies of this package; leave it out")
    if not is_loaded:
        is_expert = settings.policy == "expert"
        resolved = resolve_env(settings.task, {**settings.env, "expert": is_expert})
        from ba_torchrl.envs.policies import expert_policy  # imports torch

        return resolved, expert_policy if is_expert else None
    if settings.policy.startswith(LEROBOT):
        from ba_torchrl.training.lerobot_policy import load_lerobot

        policy = load_lerobot(settings.policy.removeprefix(LEROBOT))
    else:
        policy = _trained(settings)
    if settings.task not in (None, policy.task):
        raise ConfigError(f"task: {settings.policy} is a policy of {policy.task}")
    return policy.resolved_env.changed(**settings.env), policy


def _trained(settings: Settings) -> TrainedPolicy:
    from ba_torchrl import load_policy

    try:
        name = settings.task if settings.policy == "trained" else settings.policy
        return load_policy(name, acting=settings.algorithm)
    except UnknownNameError as error:
        known = ("expert", "random", "trained", *error.known)
        hint = f"; others are expert, random and trained{error.hint}"
        raise UnknownNameError(error.kind, error.name, known, hint) from None


COMMAND = Command(main, Settings, positional="task")
