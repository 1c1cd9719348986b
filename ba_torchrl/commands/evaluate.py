"""Evaluate a trained policy.

ba-torchrl evaluate runs/my-run episodes=100 video=my-run.mp4
ba-torchrl evaluate runs/my-run which=latest
ba-torchrl evaluate close_loop/block_picking       # that which the package ships
ba-torchrl evaluate trained folder=runs/trained    # all that the package ships; resumable
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import (
    Count,
    OutputFolder,
    PluginSettings,
    Seed,
    Text,
    VectorSettings,
    VideoFile,
)
from ba_torchrl.core.config import FIRST_TEST_SEED, Which
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import json_bytes, write_text
from ba_torchrl.record.logging import progress_bar
from ba_torchrl.record.results import CITABLE_EPISODES, RunResult, TestedPolicy
from ba_torchrl.record.statistics import wilson
from ba_torchrl.record.video import write_video

if TYPE_CHECKING:
    from ba_torchrl.training.policy import TrainedPolicy


class EpisodeSettings(VectorSettings, PluginSettings):
    """A policy and the episodes that it plays."""

    policy: Text
    """A run folder, one of the checkpoints in it, a .safetensors file, a task whose policy the
    package ships, or in evaluate "trained" for all of these."""
    which: Which = "best"
    """Of a run folder: the checkpoint with the best evaluation, or the latest."""
    device: Text = "auto"
    """Where the policy is computed, whatever device it was trained on."""
    episodes: Count = 100
    """Their number. A number to cite has 500, at least 200."""


class Settings(EpisodeSettings):
    """Settings of this command."""

    seed: Seed | None = None
    """Of the first of other episodes; null for those of the protocol, which training never used."""
    folder: OutputFolder | None = None
    """Of policies from files: the record of each as JSON, whose episodes are not played again."""
    video: VideoFile | None = None
    """A file such as evaluation.mp4 or evaluation.gif."""
    video_episodes: Count = 5
    """Episodes in the video."""


def main(settings: Settings) -> None:
    """Play greedy episodes with a policy, or with every policy that the package ships."""
    from ba_torchrl.training.policy import shipped_policies

    sources = shipped_policies() if settings.policy == "trained" else [settings.policy]
    if settings.video is not None and len(sources) > 1:
        raise ConfigError("video: name one policy")
    if settings.folder is not None and settings.seed is not None:
        raise ConfigError("folder: it keeps records under the protocol; leave out seed")
    for source in sources:
        _evaluate(source, settings)


def play(
    policy: TrainedPolicy,
    settings: EpisodeSettings,
    seed: int = FIRST_TEST_SEED,
) -> TestedPolicy:
    """Play greedy episodes in new environments, by default those of the protocol."""
    from ba_torchrl import make_vector_env
    from ba_torchrl.training.protocol import run_test

    env = make_vector_env(
        policy.config.resolved_env,
        settings.num_envs,
        parallel=settings.parallel,
        register_modules=settings.plugins,
    )
    try:
        with progress_bar(total=settings.episodes, unit="episode") as bar:
            updates, episodes = policy.updates, settings.episodes
            return run_test(env, policy, updates, episodes, lambda _: bar.update(), seed)
    finally:
        env.close()


def _evaluate(source: str, settings: Settings) -> None:
    from ba_torchrl import load_policy
    from ba_torchrl.training.evaluation import record_episodes
    from ba_torchrl.training.protocol import PROTOCOL

    policy = load_policy(source, settings.which, settings.device)
    if settings.folder is not None and policy.card is None:
        raise ConfigError("folder: it is for policies from files; a run has its result.json")
    seed = FIRST_TEST_SEED if settings.seed is None else settings.seed
    if settings.folder is None:
        found = play(policy, settings, seed)
    else:
        found = _recorded(policy, settings).last
    _, low, high = wilson(found.success_rate, found.episodes)
    print(
        f"success_rate {found.success_rate:.2f} (95 % interval {low:.2f} to {high:.2f}) over "
        f"{found.episodes} episodes of {policy.task}, {found.mean_length:.1f} steps each"
    )
    if policy.card is not None:
        card = policy.card
        low, high = card.interval
        print(
            f"  card      {card.success_rate:.2f} ({low:.2f} to {high:.2f}) over {card.episodes} "
            f"episodes{'' if card.protocol else ', before protocol 1'}"
        )
    print(f"  policy    update {policy.updates}, {policy.source}")
    if settings.seed is not None:
        print(f"  episodes  seed {seed}, not those of the protocol")
    elif found.is_citable:
        print(f"  episodes  protocol {PROTOCOL}")
    else:
        print(
            f"  episodes  protocol {PROTOCOL}; not citable: fewer than {CITABLE_EPISODES} episodes"
        )
    resolved = policy.config.resolved_env
    if settings.video is not None:
        frames = record_episodes(resolved, policy, settings.video_episodes, seed)
        print(f"  video     {write_video(settings.video, frames, fps=resolved.video_fps)}")


def _recorded(policy: TrainedPolicy, settings: Settings) -> RunResult:
    """Return the record that a file of the folder holds, or play the test and write that file.

    It is played again if the policy's file, its card, the number of episodes, or a version of
    protocol, task or packages is another. The commit alone makes no difference.
    """
    from ba_torchrl.training.policy import policy_result

    def key(record: RunResult) -> dict[str, object]:
        packages = {name: each for name, each in record.versions.items() if name != "commit"}
        whole = record.model_dump(exclude={"last", "best", "finished", "hardware"})
        return {**whole, "versions": packages, "episodes": record.last.episodes}

    file = Path(settings.folder) / f"{policy.task.replace('/', '_')}.json"
    try:
        saved = RunResult.model_validate_json(json_bytes(file))
        if key(saved) == {**key(policy_result(policy, saved.last)), "episodes": settings.episodes}:
            return saved
    except (OSError, ValueError):
        pass  # there is none, or it is damaged
    record = policy_result(policy, play(policy, settings))
    write_text(file, record.model_dump_json() + "\n")
    return record


COMMAND = Command(main, Settings, positional="policy")
