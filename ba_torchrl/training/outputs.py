"""Outputs of a finished run: learning curve, video and result, in the run folder."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ba_torchrl.algorithms.base import Learner
from ba_torchrl.core.errors import MissingPackageError, install_command
from ba_torchrl.core.hardware import hardware
from ba_torchrl.demonstrations.demo_files import recorded_expert
from ba_torchrl.envs.policies import Policy
from ba_torchrl.record.results import (
    CurvePoint,
    PolicyTest,
    RunResult,
    now,
    versions,
    write_result,
)
from ba_torchrl.record.video import write_video
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.evaluation import record_episodes
from ba_torchrl.training.protocol import PROTOCOL, count_parameters, test_seed
from ba_torchrl.training.state import RunState


def check_packages(config: ExperimentConfig) -> None:
    """Raise `MissingPackageError` unless the packages are installed that the run needs when it
    ends."""
    needed = ["matplotlib", *(["imageio_ffmpeg"] if config.video_episodes else [])]
    if missing := [name.replace("_", "-") for name in needed if find_spec(name) is None]:
        what = "a run's curve and video need packages that are not installed"
        raise MissingPackageError(what, install_command(*missing))


def plot_curve(config: ExperimentConfig, curve: list[CurvePoint]) -> Path:
    """Draw the learning curve with its standard error; return the file."""
    from ba_torchrl.record.plots import Learning, plot_panels  # needs matplotlib

    path = config.folder / "learning_curve.png"
    updates, rates, errors = np.reshape(
        [(point.updates, point.success_rate, point.standard_error) for point in curve], (-1, 3)
    ).T
    plot_panels(
        {config.task: {config.label: Learning((updates, rates, rates - errors, rates + errors))}},
        [path],
        names=[config.label],
        ylabel="success rate of the greedy policy",
        panel_in=(5, 3.6),
    )
    return path


def record_video(config: ExperimentConfig, policy: Policy) -> Path | None:
    """Record greedy episodes; return the file, None if the run wants no video."""
    if not config.video_episodes:
        return None
    frames = record_episodes(config.env, policy, config.video_episodes, test_seed(0))
    return write_video(config.folder / "evaluation.mp4", frames, fps=config.env.video_fps)


def write_run_result(
    config: ExperimentConfig,
    learner: Learner,
    last: PolicyTest,
    best: PolicyTest,
    state: RunState,
    files: dict[str, Path | None],
) -> RunResult:
    """Write the result of a run into its folder, and return it.

    Args:
        last: test of the policy that training ended with.
        best: test of the checkpoint with the best evaluation.
        files: the run's other files by name; None for one that was not written.
    """
    folder, task = config.folder.resolve(), config.env.task_class
    result = RunResult(
        protocol=PROTOCOL,
        task=config.task,
        task_version=task.version,
        expert_version=state.expert_version,
        label=config.label,
        benchmark=config.benchmark,
        seed=config.seed,
        curve=state.curve,
        last=last,
        best=best,
        demonstrations=state.demonstrations,
        demonstration_steps=state.demonstration_steps,
        env_steps=state.env_steps,
        expert_labels=state.expert_labels,
        precision=", then ".join(state.precisions),
        parameters=count_parameters(learner.policy),
        config=config.resolved(),
        versions=versions(),
        hardware=hardware(config.torch_device),
        seconds=sum(state.phase_seconds.values()),
        phase_seconds=state.phase_seconds,
        resumed_at=state.resumed_at,
        finished=now(),
        files={
            name: path.resolve().relative_to(folder).as_posix()
            for name, path in files.items()
            if path is not None
        },
    )
    write_result(config.folder, result)
    return result


def expert_version(config: ExperimentConfig) -> int | None:
    """Return the version of the expert that plays demonstrations for a run, or labels its states.

    None if there is none, and of demonstrations that do not name it.
    """
    present = config.env.task_class.expert_version
    if config.algorithm.imitates == "expert_everywhere":
        return present
    if config.demonstrations and config.demonstrations_path is not None:
        return recorded_expert(config.demonstrations_path, config.demonstrations_mapping)
    return present if config.demonstrations else None
