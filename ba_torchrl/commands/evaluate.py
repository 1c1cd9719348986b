"""Evaluate a trained policy.

ba-torchrl evaluate runs/my-run episodes=100 video=my-run.mp4
ba-torchrl evaluate runs/my-run which=latest
ba-torchrl evaluate runs/my-run expert=true        # close loop: compare the actions
ba-torchrl evaluate trained task=close_loop/block_picking
ba-torchrl evaluate trained folder=runs/trained    # all that the package ships; resumable
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import (
    Count,
    OutputFolder,
    PluginSettings,
    Seed,
    TaskId,
    Text,
    VectorSettings,
    VideoFile,
)
from ba_torchrl.config import Which
from ba_torchrl.data.files import read_json, write_text
from ba_torchrl.errors import ConfigError
from ba_torchrl.record.logging import progress_bar
from ba_torchrl.record.results import wilson_interval
from ba_torchrl.record.video import write_video
from ba_torchrl.tasks.base import versions_of

if TYPE_CHECKING:
    from tensordict import TensorDict

    from ba_torchrl.training.evaluation import Evaluation
    from ba_torchrl.training.policy import TrainedPolicy


class EpisodeSettings(VectorSettings, PluginSettings):
    """A policy and the episodes that it plays."""

    policy: Text
    """A run folder, one of the checkpoints in it, a .safetensors file, or in evaluate "trained" for
    those that the package ships."""
    which: Which = "best"
    """Of a run folder: the checkpoint with the best evaluation, or the latest."""
    device: Text = "auto"
    """Where the policy is computed, whatever device it was trained on."""
    episodes: Count = 100
    """Their number."""
    seed: Seed | None = None
    """Of the episodes; null for episodes that training did not use."""


class Settings(EpisodeSettings):
    """Settings of this command."""

    task: TaskId | None = None
    """Of policy=trained; null for all of them."""
    folder: OutputFolder | None = None
    """Of policy=trained: a JSON file per policy, whose episodes are not played again."""
    expert: bool = False
    """Close loop: compare the policy's actions with the expert's, by component."""
    video: VideoFile | None = None
    """A file such as evaluation.mp4 or evaluation.gif."""
    video_episodes: Count = 5
    """Episodes in the video."""


def main(settings: Settings) -> None:
    """Play greedy episodes with a policy, or with every policy that the package ships."""
    from ba_torchrl.training.policy import shipped_policies

    if settings.policy != "trained":
        if settings.task is not None:
            raise ConfigError("task: the policy names its task; leave it out")
        if settings.folder is not None:
            raise ConfigError("folder: it is for policy=trained; leave it out")
        _evaluate(settings.policy, settings)
    elif settings.folder is not None and (settings.expert or settings.video is not None):
        raise ConfigError("folder: it keeps success and length; leave out expert and video")
    elif settings.task is not None:
        _evaluate(settings.task, settings)
    else:
        if settings.video is not None:
            raise ConfigError("video: name the task of the policy")
        for task in shipped_policies():
            _evaluate(task, settings)


def play(
    policy: TrainedPolicy,
    settings: EpisodeSettings,
    episodes: list[TensorDict] | None = None,
    expert: bool = False,
) -> Evaluation:
    """Play greedy episodes in new environments.

    Args:
        policy: acts.
        settings: of the episodes.
        episodes: which they are appended to.
        expert: add the expert's actions to them.
    """
    from ba_torchrl import make_vector_env
    from ba_torchrl.training.evaluation import evaluate

    seed = policy.test_seed if settings.seed is None else settings.seed
    env = make_vector_env(
        policy.config.resolved_env,
        settings.num_envs,
        parallel=settings.parallel,
        register_modules=settings.plugins,
        seed=seed,
        expert=expert,
    )

    def on_episode(episode: TensorDict) -> None:
        if episodes is not None:
            episodes.append(episode)
        bar.update()

    try:
        with progress_bar(total=settings.episodes, unit="episode") as bar:
            return evaluate(env, policy, settings.episodes, seed, on_episode)
    finally:
        env.close()


def _evaluate(source: str, settings: Settings) -> None:
    from ba_torchrl import load_policy
    from ba_torchrl.training.agreement import agreement_table, check_comparable
    from ba_torchrl.training.evaluation import record_episodes

    policy = load_policy(source, settings.which, settings.device)
    if settings.expert:
        check_comparable(policy.task)
    seed = policy.test_seed if settings.seed is None else settings.seed
    episodes: list[TensorDict] = []
    if settings.folder is None:
        found = play(policy, settings, episodes, settings.expert)
    else:
        found = _kept(policy, settings, seed)
    low, high = wilson_interval(found.successes, found.episodes)
    print(
        f"success_rate {found.success_rate:.2f} (95 % interval {low:.2f} to {high:.2f}) over "
        f"{found.episodes} episodes of {policy.task}, {found.mean_length:.1f} steps each"
    )
    if policy.card is not None:
        card = policy.card
        low, high = card.interval
        print(
            f"  card      {card.success_rate:.2f} ({low:.2f} to {high:.2f}) over {card.episodes} "
            "episodes"
        )
    print(f"  policy    update {policy.updates}, {policy.source}")
    chosen = ", none of which training used" if settings.seed is None else ""
    print(f"  episodes  seed {seed}{chosen}")
    resolved = policy.config.resolved_env
    if settings.expert:
        print(f"\n{agreement_table(episodes, resolved.actions.sequence)}")
    if settings.video is not None:
        frames = record_episodes(resolved, policy, settings.video_episodes, seed)
        print(f"  video     {write_video(settings.video, frames, fps=resolved.video_fps)}")


def _kept(policy: TrainedPolicy, settings: Settings, seed: int) -> Evaluation:
    """Return the evaluation that a file of the folder holds, or play it and write that file.

    It is played again if the policy's file, the episodes or the version of the task are others.
    """
    from ba_torchrl.training.evaluation import Evaluation

    file = Path(settings.folder) / f"{policy.task.replace('/', '_')}.json"
    asked: dict[str, Any] = {
        "task": policy.task,
        "label": policy.config.label,
        "policy": hashlib.sha256(policy.source.read_bytes()).hexdigest(),
        "seed": seed,
        "episodes": settings.episodes,
        "num_envs": settings.num_envs,
        "task_version": versions_of(policy.task).task,
    }
    try:
        saved = dict(read_json(file))
        if asked.items() <= saved.items():
            return Evaluation(**{field.name: saved[field.name] for field in fields(Evaluation)})
    except (OSError, ValueError, TypeError, KeyError):
        pass  # there is none, or it is damaged
    found = play(policy, settings)
    interval = wilson_interval(found.successes, found.episodes)
    write_text(file, json.dumps({**asked, **asdict(found), "interval": interval}, indent=2) + "\n")
    return found


COMMAND = Command(main, Settings, positional="policy")
