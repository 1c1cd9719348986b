"""Experiment: the one training loop. Collect, store, update, evaluate, save."""

from __future__ import annotations

import logging
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from tqdm import tqdm

from ba_torchrl import make_vector_env
from ba_torchrl.config import ConfigError
from ba_torchrl.data.demos import as_transitions, collect_demonstrations, load_demonstrations
from ba_torchrl.data.episodes import mean_length, success_rate
from ba_torchrl.envs import keys
from ba_torchrl.record.logging import ScalarLog
from ba_torchrl.record.plots import plot_learning_curve
from ba_torchrl.record.video import write_video
from ba_torchrl.training.checkpoint import Checkpoints, build_algorithm, write_config
from ba_torchrl.training.config import ExperimentConfig, SeedUse
from ba_torchrl.training.evaluation import Evaluation, acting_on, evaluate, film

logger = logging.getLogger(__name__)

RECENT_EPISODES = 100


@dataclass(frozen=True)
class Result:
    """What a run ended with, and where to find it."""

    evaluation: Evaluation
    updates: int
    """Age of the policy that was evaluated."""
    checkpoint: Path
    curve: Path
    video: Path | None
    seconds: float


class Experiment:
    """A training run, from demonstrations to the last evaluation.

    Args:
        config: the run.
        progress: show a progress bar.
    """

    def __init__(self, config: ExperimentConfig, progress: bool = True) -> None:
        self.config = config
        self.progress = progress
        if config.threads is not None:
            torch.set_num_threads(config.threads)
        self.algorithm = build_algorithm(config)
        write_config(config)
        self._greedy = acting_on(self.algorithm.policy, config.torch_device)
        self.checkpoints = Checkpoints(config.folder, self.algorithm, config.torch_device)
        self.log = ScalarLog(config.folder, config.logger, config.model_dump(mode="json"))
        self._train_env: EnvBase | None = None
        self._eval_env: EnvBase | None = None
        self._curve: list[tuple[int, Evaluation]] = []
        self._recent: deque[bool] = deque(maxlen=RECENT_EPISODES)
        self._env_steps = 0
        self._faults = 0
        self._bar = tqdm(total=config.total_updates, disable=not progress, unit="update")

    def run(self) -> Result:
        """Train, evaluate, and write curve, video and checkpoint into the run folder."""
        started = time.perf_counter()
        try:
            self._demonstrate()
            self._learn()
            return self._finish(started)
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
            env = self._make_env(seed, expert=True)
            try:
                episodes = collect_demonstrations(
                    env,
                    config.demonstrations,
                    seed=seed,
                    only_successful=config.only_successful_demonstrations,
                )
            finally:
                env.close()
        if not episodes:
            raise RuntimeError(
                "the expert did not succeed once; see only_successful_demonstrations"
            )
        for episode in episodes:
            self.algorithm.extend(as_transitions(episode, is_expert=True))
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
        for _ in range(config.pretrain_updates):
            self._update()
        if algorithm.updates == config.total_updates:
            return
        self._train_env = self._make_env(config.derived_seed(SeedUse.COLLECTION))
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

    def _finish(self, started: float) -> Result:
        """Evaluate for the record, on episodes that chose nothing; write curve and video."""
        config = self.config
        checkpoint = self._evaluate_and_save()
        if config.report == "best":
            checkpoint = self.checkpoints.load_best()
        evaluation = self._evaluate(config.final_eval_episodes, SeedUse.REPORT)
        self.log.write(self.algorithm.updates, evaluation.scalars("final"))
        curve = config.folder / "learning_curve.png"
        updates = [updates for updates, _ in self._curve]
        rates = [item.success_rate for _, item in self._curve]
        errors = [item.standard_error for _, item in self._curve]
        low = [rate - error for rate, error in zip(rates, errors, strict=True)]
        high = [rate + error for rate, error in zip(rates, errors, strict=True)]
        plot_learning_curve(
            {config.label: (updates, rates, low, high)},
            curve,
            title=config.task,
            xlabel="updates",
            ylabel="success rate of the greedy policy",
        )
        video = None
        if config.video_episodes:
            video = config.folder / "evaluation.mp4"
            frames = film(
                config.task,
                config.env,
                self._greedy,
                config.video_episodes,
                config.derived_seed(SeedUse.REPORT),
            )
            write_video(video, frames, fps=5)
        seconds = time.perf_counter() - started
        return Result(evaluation, self.algorithm.updates, checkpoint, curve, video, seconds)

    # -- parts -------------------------------------------------------------------------------

    def _make_env(self, seed: int, expert: bool = False) -> EnvBase:
        config = self.config
        return make_vector_env(
            config.task,
            config.num_envs,
            parallel=config.parallel,
            start_method=config.start_method,
            **{**config.env, "seed": seed, "expert": expert},
        )

    def _store(self, data: TensorDict) -> None:
        """Add collected transitions to the replay and keep score of the episodes."""
        self._env_steps += data.numel()
        following = data[keys.NEXT]
        self._faults += int(following[keys.FAULT].sum())
        ended = following[keys.DONE].squeeze(-1) & ~following[keys.FAULT].squeeze(-1)
        self._recent.extend(following[keys.SUCCESS].squeeze(-1)[ended].tolist())
        self.algorithm.extend(as_transitions(data, is_expert=False))

    def _update(self) -> None:
        """Take one update, and whatever is due after it."""
        config = self.config
        scalars = self.algorithm.update()
        updates = self.algorithm.updates
        self._bar.update()
        if updates % config.log_every == 0:
            values = {f"train/{key}": float(value) for key, value in scalars.items()}
            values |= {"train/env_steps": self._env_steps, "train/faults": self._faults}
            if self._recent:
                values["train/success_rate"] = sum(self._recent) / len(self._recent)
            self.log.write(updates, values)
        if updates % config.eval_every == 0 and updates < config.total_updates:
            self._evaluate_and_save()

    def _evaluate_and_save(self) -> Path:
        """Add a point to the learning curve and write a checkpoint that bears its success rate."""
        updates = self.algorithm.updates
        evaluation = self._evaluate(self.config.eval_episodes, SeedUse.EVALUATION)
        self._curve.append((updates, evaluation))
        self.log.write(updates, evaluation.scalars("eval"))
        self._bar.set_postfix(success=f"{evaluation.success_rate:.2f}")
        return self.checkpoints.save(updates, evaluation.success_rate)

    def _evaluate(self, episodes: int, use: SeedUse) -> Evaluation:
        seed = self.config.derived_seed(use)
        if self._eval_env is None:
            self._eval_env = self._make_env(seed)
        return evaluate(self._eval_env, self._greedy, episodes, seed)
