"""Show a task: the expert, random actions or a trained policy, in a video or in a window.

With policy=keyboard a person moves the gripper of a close-loop task in PyBullet's window, and the
episodes are written as demonstrations. An arrow moves it by a step, space closes the gripper; the
terminal lists the other keys.

ba-torchrl play open_loop/covid_test
ba-torchrl play close_loop/block_picking policy=trained
ba-torchrl play close_loop/block_pushing policy=random episodes=3
ba-torchrl play policy=runs/my-run video=my-run.gif
ba-torchrl play close_loop/corner_picking video=null env.render=true   # needs a display
ba-torchrl play close_loop/block_picking policy=keyboard path=demos/mine episodes=10
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from pydantic import Field

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Count, EnvSettings, NewPath, TaskId, Text, VideoFile
from ba_torchrl.core.actions import CloseLoopActions
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import complete_only
from ba_torchrl.envs.settings import ResolvedEnv, check_env, resolve_env
from ba_torchrl.record.video import write_video

if TYPE_CHECKING:
    from ba_torchrl.demonstrations.episodes import Policy


class Settings(EnvSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {"seed": "set seed", "expert": "set policy"}
    task: TaskId | None = None
    """Id of the task; a policy of a run knows its own."""
    policy: Text = "expert"
    """expert, random, keyboard, trained (the policy that the package ships), or a run folder, a
    checkpoint or a .safetensors file."""
    episodes: Count = 1
    """Their number."""
    path: NewPath | None = None
    """New folder of the demonstrations of policy=keyboard."""
    only_successful: bool = True
    """Keyboard: leave out failed episodes."""
    video: VideoFile | None = "play.mp4"
    """A file such as play.mp4 or play.gif, or null; of the keyboard there is none."""
    fps: Annotated[float, Field(ge=1, le=240)] | None = None
    """Frames a second, or steps a second while a key is down; null for 5 in close loop and 10 in
    open loop, where frames between the poses of a step show the arm move, by interpolation."""


def main(settings: Settings) -> None:
    """Play episodes and write a video of them, or demonstrations."""
    if settings.task is not None and settings.policy in ("expert", "random"):
        check_env(settings.task, settings.env)  # before the import of torch
    import torch

    from ba_torchrl.training.evaluation import record_episodes

    if settings.policy == "keyboard":
        _record_keyboard(settings)
        return
    if settings.path is not None:
        raise ConfigError("path: only policy=keyboard records; see ba-torchrl collect")
    if not settings.only_successful:
        raise ConfigError("only_successful: only policy=keyboard records; leave it out")
    resolved, policy = _task_and_policy(settings)
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
    from ba_torchrl import load_policy
    from ba_torchrl.demonstrations.collect import expert_policy

    is_loaded = settings.policy not in ("expert", "random")
    if settings.task is None and (not is_loaded or settings.policy == "trained"):
        raise ConfigError(f"task is missing: policy={settings.policy} acts in any, see --help")
    if not is_loaded:
        is_expert = settings.policy == "expert"
        resolved = resolve_env(settings.task, {**settings.env, "expert": is_expert})
        return resolved, expert_policy if is_expert else None
    policy = load_policy(settings.task if settings.policy == "trained" else settings.policy)
    if settings.task not in (None, policy.task):
        raise ConfigError(f"task: {settings.policy} is a policy of {policy.task}")
    return policy.config.resolved_env.changed(**settings.env), policy


def _record_keyboard(settings: Settings) -> None:
    """Write the episodes that a person plays, the complete ones if it is interrupted."""
    from ba_torchrl import make
    from ba_torchrl.demonstrations.demo_files import save_demonstrations
    from ba_torchrl.demonstrations.episodes import success_rate
    from ba_torchrl.demonstrations.teleoperation import Keyboard, KeyEvents, record_demonstrations

    if settings.task is None or settings.path is None:
        missing = "task" if settings.task is None else "path, a folder for the demonstrations,"
        raise ConfigError(f"{missing} is missing: policy=keyboard needs it")
    if settings.video not in (None, Settings.model_fields["video"].default):
        raise ConfigError("video: policy=keyboard writes none; leave it out")
    resolved = resolve_env(settings.task, {**settings.env, "render": True})
    if not isinstance(resolved.actions, CloseLoopActions):
        raise ConfigError(
            f"policy: the keyboard moves the gripper of close-loop tasks; the actions of "
            f"{settings.task} are poses, record its expert by ba-torchrl collect"
        )
    kept = []
    written = ExitStack()
    scratch = written.enter_context(complete_only(Path(settings.path)))
    env = make(resolved, seed=settings.seed)
    # after the lines that PyBullet writes when it opens the window
    print(f"keys in the window:\n{Keyboard(resolved.actions).help()}")
    try:
        for episode in record_demonstrations(
            env,
            KeyEvents(env, settings.fps or resolved.video_fps),
            settings.episodes,
            seed=settings.seed,
            only_successful=settings.only_successful,
            show=lambda text: print(text, flush=True),
        ):
            kept.append(episode)
    except KeyboardInterrupt:
        print("interrupted")
    finally:
        env.close()
        with written:  # also if an error ends the recording
            if kept:
                save_demonstrations(
                    scratch,
                    kept,
                    task=settings.task,
                    env=settings.env,
                    seed=settings.seed,
                    source="keyboard",
                )
    where = f", success {success_rate(kept):.2f}, in {settings.path}" if kept else ""
    print(f"{len(kept)} episodes of {settings.task}{where}")


COMMAND = Command(main, Settings, positional="task")
