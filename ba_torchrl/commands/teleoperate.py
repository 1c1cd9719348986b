"""Record demonstrations of a close-loop task by keyboard, in PyBullet's window.

An arrow moves the gripper by a step, space closes it; the terminal lists the other keys.

ba-torchrl teleoperate close_loop/block_picking path=demos/mine episodes=10
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import ClassVar

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Count, EnvSettings, Fps, NewPath, TaskId
from ba_torchrl.core.actions import CloseLoopActions
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import atomic_output
from ba_torchrl.envs.settings import resolve_env


class Settings(EnvSettings):
    """Settings of this command."""

    set_by_command: ClassVar[dict[str, str]] = {
        "seed": "set seed",
        "expert": "play yourself",
        "render": "look at the window",
    }
    task: TaskId
    """Id of the task."""
    path: NewPath
    """New folder of the demonstrations."""
    episodes: Count = 1
    """Their number."""
    only_successful: bool = True
    """Leave out failed episodes."""
    fps: Fps | None = None
    """Steps a second while a key is down; null for 5."""


def main(settings: Settings) -> None:
    """Write the episodes that a person plays, the complete ones if it is interrupted."""
    resolved = resolve_env(settings.task, {**settings.env, "render": True})
    if not isinstance(resolved.actions, CloseLoopActions):
        raise ConfigError(
            f"task: the keyboard moves the gripper of close-loop tasks; the actions of "
            f"{settings.task} are poses, record its expert by ba-torchrl collect"
        )
    from ba_torchrl import make
    from ba_torchrl.demonstrations.demo_files import save_demonstrations
    from ba_torchrl.demonstrations.episodes import success_rate
    from ba_torchrl.demonstrations.teleoperation import Keyboard, KeyEvents, record_demonstrations

    kept = []
    written = ExitStack()
    scratch = written.enter_context(atomic_output(Path(settings.path)))
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
