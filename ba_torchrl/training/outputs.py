"""Outputs of a finished run: learning curve, video and result record, in the run folder."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from ba_torchrl.algorithms.base import SeedUse
from ba_torchrl.data.episodes import Policy
from ba_torchrl.hardware import hardware
from ba_torchrl.record.plots import plot_learning_curve
from ba_torchrl.record.results import (
    CurvePoint,
    FinalEvaluation,
    RunResult,
    now,
    versions,
    write_result,
)
from ba_torchrl.record.video import write_video
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.evaluation import Evaluation, record_episodes
from ba_torchrl.training.resume import Progress


@dataclass(frozen=True)
class Result:
    """The last evaluation of a run, and the files that it wrote."""

    evaluation: Evaluation
    updates: int
    """Updates of the evaluated policy."""
    checkpoint: Path
    curve: Path
    video: Path | None
    record: Path
    """All of this and the whole curve as JSON; see `ba_torchrl.record.results`."""
    seconds: float


def plot_curve(config: ExperimentConfig, curve: list[CurvePoint]) -> Path:
    """Draw the learning curve with its standard error; return the file."""
    return plot_learning_curve(
        {
            config.label: (
                [point.updates for point in curve],
                [point.success_rate for point in curve],
                [point.success_rate - point.standard_error for point in curve],
                [point.success_rate + point.standard_error for point in curve],
            )
        },
        config.folder / "learning_curve.png",
        title=config.task,
        xlabel="updates",
        ylabel="success rate of the greedy policy",
    )


def record_video(config: ExperimentConfig, policy: Policy) -> Path | None:
    """Record greedy episodes; return the file, None if the run wants no video."""
    if not config.video_episodes:
        return None
    seed = config.derived_seed(SeedUse.REPORT)
    frames = record_episodes(config.resolved_env, policy, config.video_episodes, seed)
    return write_video(config.folder / "evaluation.mp4", frames, fps=config.resolved_env.video_fps)


def write_record(
    config: ExperimentConfig,
    evaluation: Evaluation,
    updates: int,
    progress: Progress,
    seconds: float,
    files: dict[str, Path | None],
) -> Path:
    """Write the run's result as JSON; return the file.

    Args:
        config: of the run.
        evaluation: the one that is reported.
        updates: of the evaluated policy.
        progress: learning curve and resumptions.
        seconds: wall time of the run.
        files: the run's other files by name; None for one that was not written.
    """
    folder = config.folder.resolve()
    return write_result(
        config.folder,
        RunResult(
            task=config.task,
            label=config.label,
            benchmark=config.benchmark,
            seed=config.seed,
            curve=progress.curve,
            final=FinalEvaluation(policy=config.report, updates=updates, **asdict(evaluation)),
            config=config.resolved(),
            versions=versions(),
            hardware=hardware(config.torch_device),
            seconds=seconds,
            resumed_at=progress.resumed_at,
            finished=now(),
            files={
                name: path.resolve().relative_to(folder).as_posix()
                for name, path in files.items()
                if path is not None
            },
        ),
    )
