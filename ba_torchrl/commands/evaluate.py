"""Evaluate a trained policy.

ba-torchrl evaluate runs/my-run episodes=100 video=my-run.mp4
ba-torchrl evaluate runs/my-run which=latest
ba-torchrl evaluate runs/my-run algorithm.executed=2     # of each chunk, in another number
ba-torchrl evaluate close_loop/block_picking       # that which the package ships
ba-torchrl evaluate policy=lerobot:outputs/act episodes=500 result=runs/act/seed0
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import model_validator
from typing_extensions import Self

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import (
    ActingSettings,
    Count,
    NewPath,
    Seed,
    Text,
    VectorSettings,
    VideoFile,
)
from ba_torchrl.core.config import FIRST_TEST_SEED, LEROBOT, LocalPath, Which
from ba_torchrl.record.logging import progress_bar
from ba_torchrl.record.results import CITABLE_EPISODES, PolicyTest, write_result
from ba_torchrl.record.video import write_video

if TYPE_CHECKING:
    from ba_torchrl.training.lerobot_policy import LeRobotPolicy
    from ba_torchrl.training.policy import TrainedPolicy


class PolicySettings(ActingSettings):
    """A policy."""

    policy: LocalPath
    """A run folder, one of the checkpoints in it, a .safetensors file, or a task whose policy the
    package ships; for evaluate and play also lerobot:FOLDER, what LeRobot trained on an export."""
    which: Which = "best"
    """Of a run folder: the checkpoint with the best evaluation, or the latest."""
    device: Text = "auto"
    """Where the policy is computed, whatever device it was trained on."""

    def load(self) -> TrainedPolicy:
        """Load the policy."""
        from ba_torchrl import load_policy

        return load_policy(self.policy, self.which, self.device, self.algorithm)


class EpisodeSettings(PolicySettings, VectorSettings):
    """A policy and the episodes that it plays."""

    episodes: Count = 100
    """Their number. A number to cite has 500, at least 200."""


class Settings(EpisodeSettings):
    """Settings of this command."""

    seed: Seed | None = None
    """Of the first of other episodes; null for those of the protocol, which training never used."""
    video: VideoFile | None = None
    """A file such as evaluation.mp4 or evaluation.gif."""
    video_episodes: Count = 5
    """Episodes in the video."""
    result: NewPath | None = None
    """Of a policy of LeRobot: folder for the result, which the leaderboard and reports read."""

    @model_validator(mode="after")
    def _check_result(self) -> Self:
        if self.result is not None and not self.policy.startswith(LEROBOT):
            raise ValueError("result is for policies of LeRobot; leave it out, a run has its own")
        if self.result is not None and self.seed is not None:
            raise ValueError("result is of the protocol's episodes; leave out seed")
        if self.algorithm and self.policy.startswith(LEROBOT):
            raise ValueError("algorithm is of policies of this package; leave it out")
        return self


def main(settings: Settings) -> None:
    """Play greedy episodes with a policy."""
    from ba_torchrl.training.evaluation import record_episodes
    from ba_torchrl.training.lerobot_policy import load_lerobot, result_of
    from ba_torchrl.training.protocol import PROTOCOL

    policy: TrainedPolicy | LeRobotPolicy
    if settings.policy.startswith(LEROBOT):
        policy = load_lerobot(settings.policy.removeprefix(LEROBOT), settings.device)
    else:
        policy = settings.load()
    seed = FIRST_TEST_SEED if settings.seed is None else settings.seed
    found = play(policy, settings, seed)
    text = success_text(found.success_rate, found.episodes, policy.task)
    print(f"{text}, {found.mean_length:.1f} steps each")
    if (known := policy.result) is not None:
        from ba_torchrl.record.statistics import wilson  # imports SciPy

        rate, low, high = wilson(known.last.success_rate, known.last.episodes)
        other = "" if known.protocol == PROTOCOL else f", protocol {known.protocol}"
        episodes = f"{known.last.episodes} episodes{other}"
        print(f"  in file   {rate:.2f} ({low:.2f} to {high:.2f}) over {episodes}")
    changed = "".join(f", algorithm.{name}={value}" for name, value in settings.algorithm.items())
    print(f"  policy    update {policy.updates}, {policy.source}{changed}")
    episodes = f"protocol {PROTOCOL}"
    if settings.seed is not None:
        episodes = f"seed {seed}, not those of the protocol"
    elif not found.is_citable:
        episodes += f"; not citable: fewer than {CITABLE_EPISODES} episodes"
    print(f"  episodes  {episodes}")
    if settings.result is not None:
        write_result(settings.result, result_of(policy, found))
        print(f"  result    {settings.result}")
    if settings.video is not None:
        frames = record_episodes(policy.resolved_env, policy, settings.video_episodes, seed)
        print(
            f"  video     {write_video(settings.video, frames, fps=policy.resolved_env.video_fps)}"
        )


def play(
    policy: TrainedPolicy | LeRobotPolicy, settings: EpisodeSettings, seed: int = FIRST_TEST_SEED
) -> PolicyTest:
    """Play greedy episodes in new environments, by default those of the protocol."""
    from ba_torchrl.training.protocol import run_test

    with (
        settings.make_env(policy.resolved_env) as env,
        progress_bar(total=settings.episodes, unit="episode") as bar,
    ):
        updates, episodes = policy.updates, settings.episodes
        return run_test(env, policy, updates, episodes, lambda _: bar.update(), seed)


def success_text(success_rate: float, episodes: int, task: str) -> str:
    """Return a success rate with its interval in words."""
    from ba_torchrl.record.statistics import wilson  # imports SciPy

    _, low, high = wilson(success_rate, episodes)
    interval = f"95 % interval {low:.2f} to {high:.2f}"
    return f"success_rate {success_rate:.2f} ({interval}) over {episodes} episodes of {task}"


COMMAND = Command(main, Settings, positional="policy")
