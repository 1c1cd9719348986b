"""Experiment: the one training loop. Collect, store, update, evaluate, save."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase
from typing_extensions import Self

from ba_torchrl.algorithms.base import SeedUse
from ba_torchrl.core import keys
from ba_torchrl.demonstrations.episodes import mean_length, success_rate
from ba_torchrl.record.logging import ScalarLog, progress_bar
from ba_torchrl.record.results import CurvePoint, PolicyTest, RunResult
from ba_torchrl.training.checkpoint import (
    Checkpoints,
    ResumeState,
    lock_run,
    open_run_folder,
    resumable_updates,
)
from ba_torchrl.training.collection import gather_demonstrations, make_env, start_collection
from ba_torchrl.training.collectors.base import Collection
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.evaluation import Evaluation, acting_on, evaluate
from ba_torchrl.training.interruption import Interruption, StopSignals
from ba_torchrl.training.learner import build_learner
from ba_torchrl.training.outputs import (
    check_packages,
    expert_version,
    plot_curve,
    record_video,
    write_run_result,
)
from ba_torchrl.training.precision import compute_path, precision
from ba_torchrl.training.protocol import run_test
from ba_torchrl.training.state import RunState

logger = logging.getLogger(__name__)

WARM_UP_UPDATES, MEASURED_UPDATES = 5, 15
"""First updates of a phase, which are slower than later ones, and those whose time is measured."""


class Experiment:
    """A training run, from demonstrations to the last evaluation.

    Args:
        config: the run. With ``resume`` an interrupted run continues from the last saved state; see
            `ba_torchrl.training.checkpoint`.
        progress: show a progress bar.

    Raises:
        ConfigError: the run folder holds another run, or this one with other settings, or another
            process runs it; or a package for its curve or video, or a machine of its collector, is
            missing.
    """

    def __init__(self, config: ExperimentConfig, progress: bool = True) -> None:
        self.config = config
        if config.threads is not None:
            torch.set_num_threads(config.threads)
        check_packages(config)
        if config.algorithm.collects:
            # before demonstrations, and before `run` handles SIGTERM: Ray sets a handler of its own
            config.collector.connect()
        if config.tf32 is not None:
            torch.backends.cuda.matmul.allow_tf32 = config.tf32
            torch.backends.cudnn.allow_tf32 = config.tf32
        self.learner = build_learner(config)
        if config.compile_mode is not None:
            self.learner.compile(config.compile_mode)
        self._greedy = acting_on(self.learner.policy, config.torch_device)
        self._lock = lock_run(config.folder)
        try:
            open_run_folder(config)
            self.checkpoints = Checkpoints(config.folder, self.learner)
            self.log = ScalarLog(config.folder, config.logger, config.model_dump(mode="json"))
        except BaseException:  # a notebook keeps this object, with its lock, in the traceback
            self._lock.release()
            raise
        self._collection: Collection | None = None
        self._eval_env: EnvBase | None = None
        self.state = RunState()
        self._resume_state = ResumeState(config.folder, self.learner, self.state)
        self._phase_start, self._measured_from_s = 0, 0.0
        self._phase_name = ""
        self._signals = StopSignals()
        self._can_save = False
        """Whether there is a state that can be saved: no update is under way, and the networks are
        as the last update left them."""
        self._last_save = time.perf_counter()
        self._bar = progress_bar(total=config.total_updates, disable=not progress, unit="update")

    def run(self) -> RunResult:
        """Train, evaluate, and write curve, video and checkpoint into the run folder.

        Raises:
            RunStopped: SIGINT or SIGTERM was received, and the state is saved.
        """
        self.state.last_time = self._last_save = time.perf_counter()
        with self._signals:  # which last until the state is saved
            try:
                if not (self.config.resume and self._resume()):
                    self._demonstrate()
                self._evaluate_if_due()  # untrained, or the run was stopped during an evaluation
                self._learn()
                return self._finish()
            except Interruption:
                raise self._signals.stopped(self._save_if_possible(), self.config.folder) from None
            except Exception:
                self._save_if_possible()
                raise
            finally:
                self.close()

    def close(self) -> None:
        """Close environments and loggers, and unlock the run folder."""
        self._bar.close()
        if self._collection is not None:
            self._collection.close()
        if self._eval_env is not None and not self._eval_env.is_closed:
            self._eval_env.close()
        self.log.close()
        self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- stages ------------------------------------------------------------------------------

    def _resume(self) -> bool:
        """Restore the last saved state; return whether there is one."""
        if not self._resume_state.load():
            return False
        self._can_save = True
        updates, state = self.learner.updates, self.state
        state.resumed_at.append(updates)
        self._bar.update(updates)
        last = state.curve[-1] if state.curve else None
        if last and 0 < last.updates == updates and not self.checkpoints.has(updates):
            self.checkpoints.save(updates, last.success_rate)  # interrupted between the two
        logger.info("the run in %s continues after update %d", self.config.folder, updates)
        return True

    def _demonstrate(self) -> None:
        """Fill the replay with demonstrations."""
        self.state.expert_version = expert_version(self.config)
        if self.config.demonstrations:
            self._store_demonstrations()
        self._can_save = True

    def _store_demonstrations(self) -> None:
        with self._phase("demonstrations"), self.state.timed("demonstrations"):
            episodes = gather_demonstrations(
                self.config, self.learner, lambda _: self._signals.check()
            )
            self.learner.on_demonstrations(episodes)
        self.state.demonstrations = len(episodes)
        self.state.demonstration_steps = sum(map(len, episodes))
        self.log.write(
            0,
            {
                "demonstrations/success_rate": success_rate(episodes),
                "demonstrations/mean_length": mean_length(episodes),
            },
        )

    def _learn(self) -> None:
        """Pretrain, then alternate collection and updates until the last update."""
        config, learner = self.config, self.learner
        computed = precision(config)
        if computed not in self.state.precisions:
            self.state.precisions.append(computed)
        first = config.algorithm.first_updates
        collects = config.algorithm.collects
        offline = first + config.pretrain_updates if collects else config.total_updates
        self._phase_start = learner.updates
        with self._phase("pretraining"):
            while learner.updates < offline and not self._is_complete:
                self._update()
        if self._is_complete:
            return
        with self.state.timed("collection"):
            self._collection = self._start_collection()
        self._phase_start = learner.updates
        with self._phase("training"):
            while not self._take_pending_updates():
                with self.state.timed("collection"):
                    steps = self._store(next(self._collection))
                if len(learner.replay) >= config.min_replay:
                    self.state.pending_updates = steps * config.updates_per_step
                self._stop_or_save()
        if learner.updates < config.total_updates:
            logger.info("the run ends at update %d: stop_at_success", learner.updates)

    def _start_collection(self) -> Collection:
        """Start to collect, and continue the episodes of a resumed run."""
        config, state = self.config, self.state
        # Without positions, a resumed run plays other episodes than before its interruption.
        part = state.resumed_at[-1] if state.env_steps and state.resumed_at else 0
        seed = config.derived_seed(SeedUse.COLLECTION, part)
        return start_collection(config, self.learner, seed, state.positions)

    def _take_pending_updates(self) -> bool:
        """Take the updates of the last step of collection; return whether the run is complete."""
        while self.state.pending_updates and not self._is_complete:
            self.state.pending_updates -= 1
            self._update()
        return self._is_complete

    @property
    def _is_complete(self) -> bool:
        """Whether all updates are taken, or the last evaluations reach `stop_at_success`."""
        if self.learner.updates == self.config.total_updates:
            return True
        target = self.config.stop_at_success
        last = [point for point in self.state.curve[-2:] if point.updates]
        if target is None or len(last) < 2:
            return False
        return all(point.success_rate >= target for point in last)

    def _finish(self) -> RunResult:
        """Test the last policy and the best checkpoint; write the result, then curve and video."""
        config, state = self.config, self.state
        if not state.curve or state.curve[-1].updates < self.learner.updates:
            self._evaluate_and_save()
        latest, best_checkpoint = (self.checkpoints.find(which) for which in ("latest", "best"))
        self._can_save = False
        last = best = self._test()
        if best_checkpoint != latest:
            self.checkpoints.load(best_checkpoint)
            best = self._test()
            self.checkpoints.load(latest)

        def write(**pictures: Path | None) -> RunResult:
            state.add_time("other")
            files = {"checkpoint": latest, "best": best_checkpoint, **pictures}
            return write_run_result(config, self.learner, last, best, state, files)

        write()
        self._resume_state.remove()
        rates = {"final/success_rate": last.success_rate, "final/mean_length": last.mean_length}
        self.log.write(last.updates, {**rates, "final/best_success_rate": best.success_rate})
        with self._phase("video"):
            curve = self._picture("learning curve", lambda: plot_curve(config, state.curve))
            video = self._picture("video", lambda: record_video(config, self._greedy))
        return write(curve=curve, video=video)

    def _picture(self, name: str, make: Callable[[], Path | None]) -> Path | None:
        """Return the file of a figure or film; None, with a warning, if it cannot be made."""
        try:
            return make()
        except Exception as error:  # of any library; the run is over and recorded
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            logger.warning("%s has no %s: %s", self.config.folder, name, reason)
            return None

    # -- parts -------------------------------------------------------------------------------

    @contextmanager
    def _phase(self, name: str) -> Iterator[None]:
        """Context in which the progress bar names what the run does."""
        before, self._phase_name = self._phase_name, name
        shows = sys.stderr.isatty()  # in a file, each refresh is a line
        self._bar.set_description(name, refresh=shows)
        try:
            yield
        finally:
            self._phase_name = before
            self._bar.set_description(before, refresh=shows)

    def _store(self, data: TensorDict) -> int:
        """Add collected transitions to the replay and count steps, faults and successes.

        Returns:
            The number of steps of all environments together that were completed.
        """
        state, following = self.state, data[keys.NEXT]
        steps_before = state.env_steps // self.config.num_envs
        is_present = ~data[keys.FAULT]  # not so while the worker of an environment starts
        state.env_steps += int(is_present.sum())
        state.faults += int((following[keys.FAULT] & is_present).sum())
        ended = following[keys.DONE].squeeze(-1) & ~following[keys.FAULT].squeeze(-1)
        state.recent.extend(following[keys.SUCCESS].squeeze(-1)[ended].tolist())
        if self.learner.config.imitates == "expert_everywhere":
            state.expert_labels += int((is_present & ~following[keys.FAULT]).sum())
        self.learner.on_collected(data)
        return state.env_steps // self.config.num_envs - steps_before

    def _update(self) -> None:
        """Take one update; log and evaluate if they are due."""
        self._can_save = False
        with self.state.timed("updates"):
            scalars = self.learner.update()
        self._can_save = True
        updates = self.learner.updates
        self._bar.update()
        self._log_duration()
        is_due = updates % self.config.log_every == 0
        if is_due:
            self._log_update(scalars)
        self._evaluate_if_due()
        if not is_due and updates < self.config.log_every and self._is_complete:
            self._log_update(scalars)  # the only row of a shorter run
        self._stop_or_save()

    def _log_update(self, scalars: TensorDict) -> None:
        """Log the scalars of an update, and counts and success of the collection."""
        names = [f"train/{key}" for key in scalars.keys()]  # noqa: SIM118, a TensorDict
        found = [value.reshape(()).float() for value in scalars.values()]
        # in one copy, since each copy from a GPU waits for it
        values = dict(zip(names, torch.stack(found).tolist(), strict=True)) if found else {}
        state = self.state
        values |= {"train/env_steps": state.env_steps, "train/faults": state.faults}
        collector = {} if self._collection is None else self._collection.scalars
        values |= {f"collector/{key}": value for key, value in collector.items()}
        if state.recent:
            values["train/success_rate"] = sum(state.recent) / len(state.recent)
        self.log.write(self.learner.updates, values)

    def _log_duration(self) -> None:
        """Log the expected duration of the remaining updates after the first ones of a phase."""
        seconds = self.state.phase_seconds["updates"] + self.state.phase_seconds["collection"]
        taken = self.learner.updates - self._phase_start
        if taken == WARM_UP_UPDATES:
            self._measured_from_s = seconds
        if taken == WARM_UP_UPDATES + MEASURED_UPDATES:
            per_update = (seconds - self._measured_from_s) / MEASURED_UPDATES
            remaining = self.config.total_updates - self.learner.updates
            logger.info(
                "%s: %.2f s an update, at most %.0f minutes for the other %d without evaluations",
                compute_path(self.config),
                per_update,
                remaining * per_update / 60,
                remaining,
            )

    def _evaluate_if_due(self) -> None:
        """Evaluate at 0 and every multiple of ``eval_every``, except at the end of the run."""
        updates, curve = self.learner.updates, self.state.curve
        is_new = not curve or updates > curve[-1].updates
        if is_new and updates % self.config.eval_every == 0 and updates < self.config.total_updates:
            self._evaluate_and_save()

    def _stop_or_save(self) -> None:
        """Stop after a signal; save the state if the last save was long ago."""
        self._signals.check()
        if time.perf_counter() - self._last_save > 60 * self.config.save_minutes:
            self._save()

    def _save(self) -> None:
        """Save the state, with the positions of the environments in their episodes."""
        self.state.add_time("other")
        if self._collection is not None:
            self.state.positions = self._collection.get_positions()
        self._resume_state.save(self.learner.updates)
        self._last_save = time.perf_counter()

    def _save_if_possible(self) -> bool:
        """Save the state of a run that ends early, if that is possible; return whether the last
        one is saved."""
        try:
            if self._can_save:
                self._save()
        except OSError as error:  # the disk is full, for example; the state before is whole
            logger.error("the state could not be saved: %s", error)
            return False
        return resumable_updates(self.config.folder) is not None

    def _evaluate_and_save(self) -> None:
        """Add a point to the learning curve; save the state and, of a trained policy, a checkpoint.

        The untrained policy has the episodes of the first trained one.
        """
        updates, state = self.learner.updates, self.state
        # A run must not end because the same episodes succeed twice.
        trained = [point for point in state.curve if point.updates]
        part = 0 if self.config.stop_at_success is None else len(trained)
        evaluation = self._evaluate(part)
        state.curve.append(
            CurvePoint(
                updates=updates,
                env_steps=state.env_steps,
                seconds=self.state.total_seconds(),
                **asdict(evaluation),
            )
        )
        self.log.write(updates, evaluation.scalars("eval"))
        self._bar.set_postfix(success=f"{evaluation.success_rate:.2f}")
        self._save()
        if updates:
            self.checkpoints.save(updates, evaluation.success_rate)

    def _evaluate(self, part: int = 0) -> Evaluation:
        """Evaluate the policy during training."""
        seed = self.config.derived_seed(SeedUse.EVALUATION, part)
        with self._evaluating() as env:
            episodes = self.config.eval_episodes
            return evaluate(env, self._greedy, episodes, seed, lambda _: self._signals.check())

    def _test(self) -> PolicyTest:
        """Test the policy under the protocol."""
        updates, episodes = self.learner.updates, self.config.final_eval_episodes
        with self._evaluating() as env:
            return run_test(env, self._greedy, updates, episodes, lambda _: self._signals.check())

    @contextmanager
    def _evaluating(self) -> Iterator[EnvBase]:
        """Context of the phase of evaluations, with their environments."""
        with self._phase("evaluation"), self.state.timed("evaluation"):
            if self._eval_env is None:
                seed = self.config.derived_seed(SeedUse.EVALUATION)
                self._eval_env = make_env(self.config, seed)
            yield self._eval_env
