"""Experiment: the one training loop. Collect, store, update, evaluate, save."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from ba_torchrl import make_vector_env
from ba_torchrl.data.demo_files import load_demonstrations
from ba_torchrl.data.demos import collect_demonstrations, source_config
from ba_torchrl.data.episodes import mean_length, success_rate
from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError
from ba_torchrl.record.logging import ScalarLog, progress_bar
from ba_torchrl.record.plots import plot_learning_curve
from ba_torchrl.record.results import (
    CurvePoint,
    FinalEvaluation,
    RunResult,
    hardware,
    now,
    versions,
    write_result,
)
from ba_torchrl.record.video import write_video
from ba_torchrl.training.checkpoint import Checkpoints, build_algorithm
from ba_torchrl.training.config import ExperimentConfig, SeedUse
from ba_torchrl.training.evaluation import Evaluation, acting_on, evaluate, record_episodes
from ba_torchrl.training.resume import Progress, ResumeState, open_run_folder

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Result:
    """What a run ended with, and where to find it."""

    evaluation: Evaluation
    updates: int
    """Age of the policy that was evaluated."""
    checkpoint: Path
    curve: Path
    video: Path | None
    record: Path
    """All of this and the whole curve as JSON; see `ba_torchrl.record.results`."""
    seconds: float


class Experiment:
    """A training run, from demonstrations to the last evaluation.

    Args:
        config: the run. With ``resume`` it goes on from its last evaluation if it was interrupted;
            `ba_torchrl.training.resume` says what is kept.
        progress: show a progress bar.

    Raises:
        ConfigError: the run folder holds another run, or one that may not be resumed like this.
    """

    def __init__(self, config: ExperimentConfig, progress: bool = True) -> None:
        self.config = config
        self.progress = progress
        if config.threads is not None:
            torch.set_num_threads(config.threads)
        self.algorithm = build_algorithm(config)
        open_run_folder(config)
        self._greedy = acting_on(self.algorithm.policy, config.torch_device)
        self.checkpoints = Checkpoints(config.folder, self.algorithm, config.torch_device)
        self.log = ScalarLog(config.folder, config.logger, config.model_dump(mode="json"))
        self._train_env: EnvBase | None = None
        self._eval_env: EnvBase | None = None
        self._progress = Progress()
        self._state = ResumeState(
            config.folder, self.algorithm, self._progress, config.torch_device
        )
        self._started = time.perf_counter()
        self._bar = progress_bar(total=config.total_updates, disable=not progress, unit="update")

    def run(self) -> Result:
        """Train, evaluate, and write curve, video and checkpoint into the run folder."""
        self._started = time.perf_counter()
        try:
            if not (self.config.resume and self._resume()):
                self._demonstrate()
            self._learn()
            return self._finish()
        finally:
            self.close()

    def close(self) -> None:
        """Close environments and loggers."""
        self._bar.close()
        for env in (self._train_env, self._eval_env):
            if env is not None and not env.is_closed:
                env.close()
        self.log.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- stages ------------------------------------------------------------------------------

    def _resume(self) -> bool:
        """Go back to the last evaluation; return whether there was one."""
        if not self._state.load():
            return False
        updates, progress = self.algorithm.updates, self._progress
        progress.resumed_at.append(updates)
        self._started -= progress.seconds
        self._bar.update(updates)
        if not self.checkpoints.has(updates):  # the interruption came between state and checkpoint
            self.checkpoints.save(updates, progress.curve[-1].success_rate)
        logger.info("%s goes on after update %d", self.config.folder, updates)
        return True

    def _demonstrate(self) -> None:
        """Fill the replay with the expert's episodes."""
        config = self.config
        if not config.demonstrations:
            return
        if config.demonstrations_path is not None:
            episodes = load_demonstrations(
                config.demonstrations_path, task=config.task, env=config.env
            )
            if len(episodes) < config.demonstrations:
                raise ConfigError(
                    f"{config.demonstrations_path} holds {len(episodes)} episodes, fewer than "
                    f"demonstrations={config.demonstrations}"
                )
            episodes = episodes[: config.demonstrations]
        else:
            seed = config.derived_seed(SeedUse.DEMONSTRATIONS)
            env = self._make_env(seed, **source_config(config.demonstrations_source))
            try:
                episodes = collect_demonstrations(
                    env,
                    config.demonstrations,
                    seed=seed,
                    source=config.demonstrations_source,
                    only_successful=config.only_successful_demonstrations,
                    nearest_action=self.algorithm.nearest_action,
                )
            finally:
                env.close()
        if not episodes:
            raise RuntimeError(
                f"no episode of the source {config.demonstrations_source!r} is of use; see "
                "demonstrations_source and only_successful_demonstrations"
            )
        self.algorithm.on_demonstrations(episodes)
        self.log.write(
            0,
            {
                "demonstrations/success_rate": success_rate(episodes),
                "demonstrations/mean_length": mean_length(episodes),
            },
        )

    def _learn(self) -> None:
        """Alternate collecting and updating until the updates are used up."""
        config, algorithm = self.config, self.algorithm
        while algorithm.updates < config.pretrain_updates:
            self._update()
        if algorithm.updates == config.total_updates:
            return
        # Other episodes than before an interruption, or the first ones would come twice.
        part = self._progress.resumed_at[-1] if self._progress.resumed_at else 0
        self._train_env = self._make_env(
            config.derived_seed(SeedUse.COLLECTION, part), expert=algorithm.stores_expert_action
        )
        collector = Collector(
            self._train_env,
            algorithm.policy,
            frames_per_batch=config.num_envs,
            total_frames=-1,
            postproc=lambda data: data.reshape(-1),
            policy_device=config.torch_device,
            storing_device="cpu",
            auto_register_policy_transforms=False,
        )
        try:
            for data in collector:
                self._store(data)
                if algorithm.replay_size < config.min_replay:
                    continue
                for _ in range(config.updates_per_step):
                    self._update()
                    if algorithm.updates == config.total_updates:
                        return
        finally:
            collector.shutdown(close_env=False)

    def _finish(self) -> Result:
        """Evaluate for the record, on episodes that chose nothing; write curve, video, result."""
        config = self.config
        curve = self._progress.curve
        if not curve or curve[-1].updates < self.algorithm.updates:
            self._evaluate_and_save()
        checkpoint = self.checkpoints.latest()
        if config.report == "best":
            checkpoint = self.checkpoints.load_best()
        evaluation = self._evaluate(config.final_eval_episodes, SeedUse.REPORT)
        self.log.write(self.algorithm.updates, evaluation.scalars("final"))
        picture = self._plot()
        video = None
        if config.video_episodes:
            video = config.folder / "evaluation.mp4"
            frames = record_episodes(
                config.task,
                config.env,
                self._greedy,
                config.video_episodes,
                config.derived_seed(SeedUse.REPORT),
            )
            write_video(video, frames, fps=5)
        seconds = time.perf_counter() - self._started
        files = {"curve": picture, "checkpoint": checkpoint, "video": video}
        record = write_result(
            config.folder,
            RunResult(
                task=config.task,
                label=config.label,
                benchmark=config.benchmark,
                seed=config.seed,
                curve=curve,
                final=FinalEvaluation(
                    policy=config.report, updates=self.algorithm.updates, **asdict(evaluation)
                ),
                config=config.resolved(),
                versions=versions(),
                hardware=hardware(config.torch_device),
                seconds=seconds,
                resumed_at=self._progress.resumed_at,
                finished=now(),
                files={
                    name: path.resolve().relative_to(config.folder.resolve()).as_posix()
                    for name, path in files.items()
                    if path is not None
                },
            ),
        )
        self._state.remove()
        return Result(
            evaluation, self.algorithm.updates, checkpoint, picture, video, record, seconds
        )

    def _plot(self) -> Path:
        """Draw the learning curve; return its file."""
        curve = self._progress.curve
        return plot_learning_curve(
            {
                self.config.label: (
                    [point.updates for point in curve],
                    [point.success_rate for point in curve],
                    [point.success_rate - point.standard_error for point in curve],
                    [point.success_rate + point.standard_error for point in curve],
                )
            },
            self.config.folder / "learning_curve.png",
            title=self.config.task,
            xlabel="updates",
            ylabel="success rate of the greedy policy",
        )

    # -- parts -------------------------------------------------------------------------------

    def _make_env(self, seed: int, **changes: bool) -> EnvBase:
        config = self.config
        return make_vector_env(
            config.task,
            config.num_envs,
            parallel=config.parallel,
            start_method=config.start_method,
            register_modules=config.plugins,
            **{**config.env, "seed": seed, **changes},
        )

    def _store(self, data: TensorDict) -> None:
        """Add collected transitions to the replay and keep score of the episodes."""
        progress, following = self._progress, data[keys.NEXT]
        progress.env_steps += data.numel()
        progress.faults += int(following[keys.FAULT].sum())
        ended = following[keys.DONE].squeeze(-1) & ~following[keys.FAULT].squeeze(-1)
        progress.recent.extend(following[keys.SUCCESS].squeeze(-1)[ended].tolist())
        self.algorithm.extend(self.algorithm.to_transitions(data, is_expert=False))

    def _update(self) -> None:
        """Take one update, and whatever is due after it."""
        config = self.config
        scalars = self.algorithm.update()
        updates = self.algorithm.updates
        self._bar.update()
        if updates % config.log_every == 0:
            values = {f"train/{key}": float(value) for key, value in scalars.items()}
            progress = self._progress
            values |= {"train/env_steps": progress.env_steps, "train/faults": progress.faults}
            if progress.recent:
                values["train/success_rate"] = sum(progress.recent) / len(progress.recent)
            self.log.write(updates, values)
        if updates % config.eval_every == 0 and updates < config.total_updates:
            self._evaluate_and_save()

    def _evaluate_and_save(self) -> None:
        """Add a point to the learning curve and write a checkpoint that bears its success rate."""
        updates, progress = self.algorithm.updates, self._progress
        evaluation = self._evaluate(self.config.eval_episodes, SeedUse.EVALUATION)
        progress.seconds = time.perf_counter() - self._started
        progress.curve.append(
            CurvePoint(
                updates=updates,
                env_steps=progress.env_steps,
                seconds=progress.seconds,
                **asdict(evaluation),
            )
        )
        self.log.write(updates, evaluation.scalars("eval"))
        self._bar.set_postfix(success=f"{evaluation.success_rate:.2f}")
        self._state.save(updates)
        self.checkpoints.save(updates, evaluation.success_rate)

    def _evaluate(self, episodes: int, use: SeedUse) -> Evaluation:
        seed = self.config.derived_seed(use)
        if self._eval_env is None:
            self._eval_env = self._make_env(seed)
        return evaluate(self._eval_env, self._greedy, episodes, seed)
