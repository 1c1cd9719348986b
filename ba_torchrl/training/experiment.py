"""Experiment: the one training loop. Collect, store, update, evaluate, save."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Self

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from ba_torchrl import make_vector_env
from ba_torchrl.algorithms.base import Algorithm
from ba_torchrl.algorithms.seeds import SeedUse
from ba_torchrl.data.demo_files import load_demonstrations
from ba_torchrl.data.demos import collect_demonstrations, source_config
from ba_torchrl.data.episodes import mean_length, success_rate
from ba_torchrl.envs import keys
from ba_torchrl.errors import ConfigError
from ba_torchrl.record.logging import ScalarLog, progress_bar
from ba_torchrl.record.results import CurvePoint
from ba_torchrl.training.checkpoint import Checkpoints, build_algorithm
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.evaluation import Evaluation, acting_on, evaluate
from ba_torchrl.training.outputs import Result, plot_curve, record_video, write_record
from ba_torchrl.training.resume import Progress, ResumeState, open_run_folder

logger = logging.getLogger(__name__)


def make_env(config: ExperimentConfig, seed: int, **changes: bool) -> EnvBase:
    """Return the environments of a run, ready to be reset.

    Args:
        config: of the run.
        seed: of the first environment.
        changes: fields of `EnvConfig` that differ from the run's.
    """
    return make_vector_env(
        config.task,
        config.num_envs,
        parallel=config.parallel,
        start_method=config.start_method,
        register_modules=config.plugins,
        **{**config.env, "seed": seed, **changes},
    )


def make_collector(env: EnvBase, algorithm: Algorithm, config: ExperimentConfig) -> Collector:
    """Return a collector of one step of every environment at a time, flattened to [num_envs].

    Args:
        env: the environments, on the CPU.
        algorithm: whose policy explores.
        config: of the run.
    """
    return Collector(
        env,
        algorithm.policy,
        frames_per_batch=config.num_envs,
        total_frames=-1,
        postproc=lambda data: data.reshape(-1),
        policy_device=config.torch_device,
        storing_device="cpu",
        auto_register_policy_transforms=False,
    )


def gather_demonstrations(config: ExperimentConfig, algorithm: Algorithm) -> list[TensorDict]:
    """Return the episodes [T] of a run's demonstrations, read from a folder or played now.

    Args:
        config: of the run.
        algorithm: whose policy must be able to choose the demonstrated actions.

    Raises:
        ConfigError: the folder holds fewer than the run asks for.
        RuntimeError: no episode can be used.
    """
    if config.demonstrations_path is not None:
        episodes = load_demonstrations(config.demonstrations_path, task=config.task, env=config.env)
        if len(episodes) < config.demonstrations:
            raise ConfigError(
                f"{config.demonstrations_path} holds {len(episodes)} episodes, fewer than "
                f"demonstrations={config.demonstrations}"
            )
        return episodes[: config.demonstrations]
    seed = config.derived_seed(SeedUse.DEMONSTRATIONS)
    env = make_env(config, seed, **source_config(config.demonstrations_source))
    try:
        episodes = collect_demonstrations(
            env,
            config.demonstrations,
            seed=seed,
            source=config.demonstrations_source,
            only_successful=config.only_successful_demonstrations,
            nearest_action=algorithm.nearest_action,
        )
    finally:
        env.close()
    if not episodes:
        raise RuntimeError(
            f"no episode of the source {config.demonstrations_source!r} can be used; see "
            "demonstrations_source and only_successful_demonstrations"
        )
    return episodes


class Experiment:
    """A training run, from demonstrations to the last evaluation.

    Args:
        config: the run. With ``resume`` an interrupted run continues from its last evaluation; see
            `ba_torchrl.training.resume`.
        progress: show a progress bar.

    Raises:
        ConfigError: the run folder holds another run, or this one with other settings.
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
        """Restore the state of the last evaluation; return whether there is one."""
        if not self._state.load():
            return False
        updates, progress = self.algorithm.updates, self._progress
        progress.resumed_at.append(updates)
        self._started -= progress.seconds
        self._bar.update(updates)
        if not self.checkpoints.has(updates):  # the interruption came between state and checkpoint
            self.checkpoints.save(updates, progress.curve[-1].success_rate)
        logger.info("the run in %s continues after update %d", self.config.folder, updates)
        return True

    def _demonstrate(self) -> None:
        """Fill the replay with demonstrations."""
        if not self.config.demonstrations:
            return
        episodes = gather_demonstrations(self.config, self.algorithm)
        self.algorithm.on_demonstrations(episodes)
        self.log.write(
            0,
            {
                "demonstrations/success_rate": success_rate(episodes),
                "demonstrations/mean_length": mean_length(episodes),
            },
        )

    def _learn(self) -> None:
        """Pretrain, then alternate collection and updates until the last update."""
        config, algorithm = self.config, self.algorithm
        collects = config.algorithm_config.collects
        pretrain_updates = config.pretrain_updates if collects else config.total_updates
        while algorithm.updates < pretrain_updates:
            self._update(algorithm.pretrain_update)
        if algorithm.updates == config.total_updates:
            return
        # A resumed run plays other episodes than before its interruption.
        part = self._progress.resumed_at[-1] if self._progress.resumed_at else 0
        seed = config.derived_seed(SeedUse.COLLECTION, part)
        self._train_env = make_env(config, seed, expert=algorithm.stores_expert_action)
        collector = make_collector(self._train_env, algorithm, config)
        try:
            for data in collector:
                self._store(data)
                if algorithm.replay_size < config.min_replay:
                    continue
                for _ in range(config.updates_per_step):
                    self._update(algorithm.update)
                    if algorithm.updates == config.total_updates:
                        return
        finally:
            collector.shutdown(close_env=False)

    def _finish(self) -> Result:
        """Run the evaluation that is reported, on new episodes; write curve, video and record."""
        config, progress = self.config, self._progress
        if not progress.curve or progress.curve[-1].updates < self.algorithm.updates:
            self._evaluate_and_save()
        checkpoint = self.checkpoints.latest()
        if config.report == "best":
            checkpoint = self.checkpoints.load_best()
        updates = self.algorithm.updates
        evaluation = self._evaluate(config.final_eval_episodes, SeedUse.REPORT)
        self.log.write(updates, evaluation.scalars("final"))
        curve = plot_curve(config, progress.curve)
        video = record_video(config, self._greedy)
        seconds = time.perf_counter() - self._started
        files = {"curve": curve, "checkpoint": checkpoint, "video": video}
        record = write_record(config, evaluation, updates, progress, seconds, files)
        self._state.remove()
        return Result(evaluation, updates, checkpoint, curve, video, record, seconds)

    # -- parts -------------------------------------------------------------------------------

    def _store(self, data: TensorDict) -> None:
        """Add collected transitions to the replay and count steps, faults and successes."""
        progress, following = self._progress, data[keys.NEXT]
        progress.env_steps += data.numel()
        progress.faults += int(following[keys.FAULT].sum())
        ended = following[keys.DONE].squeeze(-1) & ~following[keys.FAULT].squeeze(-1)
        progress.recent.extend(following[keys.SUCCESS].squeeze(-1)[ended].tolist())
        self.algorithm.extend(self.algorithm.to_transitions(data, is_expert=False))

    def _update(self, take_update: Callable[[], TensorDict]) -> None:
        """Take one update; log and evaluate if they are due."""
        config = self.config
        scalars = take_update()
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
        """Add a point to the learning curve; save the state and a checkpoint with its rate."""
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
            self._eval_env = make_env(self.config, seed)
        return evaluate(self._eval_env, self._greedy, episodes, seed)
