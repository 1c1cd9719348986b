"""VectorEnv: environments in worker processes, which are replaced when they fail."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, SupportsIndex

import numpy as np
from tensordict import NonTensorStack, TensorDict, TensorDictBase
from torchrl.data import Composite, NonTensor
from torchrl.data.utils import CloudpickleWrapper
from torchrl.envs import EnvCreator

from ba_torchrl.core import keys
from ba_torchrl.core.config import WorkerOptions
from ba_torchrl.core.errors import ConfigError, WorkerError
from ba_torchrl.envs.episode_positions import EpisodePosition
from ba_torchrl.envs.faults import MAX_CONSECUTIVE_FAULTS, DisturbedEpisodes
from ba_torchrl.envs.vector.batching import MakeEnv, Vector
from ba_torchrl.envs.vector.worker import EnvironmentRaisedError, Worker

logger = logging.getLogger(__name__)

_STEP_S = 1.0
"""Upper bound of the duration of a step that is repeated."""
_LOST_STEP = {
    keys.REWARD: 0,
    keys.TERMINATED: False,
    keys.TRUNCATED: True,
    keys.DONE: True,
    keys.SUCCESS: False,
    keys.FAULT: True,
}
_ABSENT = {**_LOST_STEP, keys.TRUNCATED: False, keys.DONE: False}
_START_POLL_S = 1.0
_POLLING_S = 0.1
_POLL_INTERVAL_S = 30e-6

Command = tuple[str, tuple[Any, ...], dict[str, Any]]
"""Name, arguments and keywords of a method of the worker's environment."""


class VectorEnv(Vector):
    """Environments in worker processes; a worker that ends or hangs is replaced.

    The other workers keep their episodes, and step while the new worker starts. For the environment
    of the failed worker, the step returns the last valid observation with ``fault``, ``truncated``
    and ``done`` set and a reward of zero; TorchRL then resets it like any environment that is done.
    An error that an environment raises is raised in this process, caused by one with the traceback
    of the worker, which continues. Errors of the simulator and of memory replace the worker.

    This reset waits for the new worker, unless ``workers.wait_for_restarts`` is False. Then the
    environment is absent until the worker is ready: the reset returns the last valid observation
    with ``fault`` set, and so does every step, which is truncated and done. A full reset always
    waits.

    Args:
        workers: how processes start and when they are replaced.
    """

    def __init__(
        self,
        num_workers: int,
        create_env_fn: MakeEnv | Sequence[MakeEnv],
        *,
        workers: WorkerOptions = WorkerOptions(),  # noqa: B008 -- immutable
    ) -> None:
        super().__init__(num_workers, create_env_fn)
        missing = {keys.TRUNCATED, keys.FAULT} - {*self.done_keys, *self.observation_keys}
        if missing:
            raise ValueError(f"environments in workers need the entries {sorted(missing)}")
        self.workers, self.wait_for_restarts = workers, workers.wait_for_restarts
        self.restarts = 0
        """Number of workers that were replaced."""
        self.shutdown_timeout = 5.0
        """Seconds after which `close` kills a worker."""
        self._workers: list[Worker] = []
        self._starts: dict[int, int] = {}
        """Numbers of failed attempts to start the workers that are not ready yet, by index."""
        self._lost: set[int] = set()
        """Indices of environments that must be reset, because their worker was replaced."""
        self._failures_in_a_row = [0] * num_workers
        self._episodes = [DisturbedEpisodes() for _ in range(num_workers)]
        self._replaced_since_seed = [0] * num_workers

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the workers, by environment."""
        return [worker.process.pid for worker in self._workers]

    def start(self) -> None:
        outputs = _zeros(self.full_observation_spec, self.full_reward_spec, self.full_done_spec)
        specs = self.observation_spec.items(True, True)
        names = [key for key, spec in specs if isinstance(spec[0], NonTensor)]
        self._texts = {key: [""] * self.num_workers for key in names}
        self._last = outputs.exclude(*names)
        self._rows = [dict(row.items(True, True)) for row in self._last.unbind(0)]
        inputs = _zeros(self.full_action_spec, self.full_state_spec).share_memory_().unbind(0)
        self._slots = list(zip(inputs, self._last.clone().share_memory_().unbind(0), strict=True))
        self._lost, self._starts = set(), dict.fromkeys(range(self.num_workers), 0)
        self._replaced_since_seed = [0] * self.num_workers
        try:
            for index in range(self.num_workers):
                self._workers.append(self._launch(index))
            self._finish_starts(wait_for_all=True)
        except BaseException:
            self.close(raise_if_closed=False)
            raise
        self.is_closed = False

    def continue_from(self, positions: Sequence[EpisodePosition]) -> None:
        steps = max(sum(map(len, position["actions"])) for position in positions)
        commands = [("call", ("continue_from", position), {}) for position in positions]
        self._ask_all(commands, self.workers.timeout_s + steps * _STEP_S)

    def get_positions(self) -> list[EpisodePosition]:
        if self._lost:
            raise WorkerError(f"the episodes of environments {sorted(self._lost)} are lost")
        return super().get_positions()

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the workers."""
        if self.is_closed and raise_if_closed:
            raise RuntimeError("the environments are closed already")
        for index, worker in enumerate(self._workers):
            if index in self._starts:
                worker.abort()
            else:
                worker.send("close", (), {})
        deadline = time.monotonic() + self.shutdown_timeout
        for worker in self._workers:
            worker.join(deadline - time.monotonic())
        self._workers, self._starts = [], {}
        super().close()

    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[Any, ...]:
        if self.is_closed:
            return super().__reduce_ex__(protocol)
        raise TypeError(
            "the processes of a vector cannot be copied: copy one with parallel=False, let another "
            "vector continue the episodes, other.continue_from(envs.get_positions()) or "
            "other.reset(envs.get_state(), set_state=True)"
        )

    # -- commands ----------------------------------------------------------------------------

    def _reset_some(self, options: Mapping[int, dict[str, Any]], *, is_full: bool) -> None:
        self._start_or_replace_dead()
        for index in options.keys() - self._lost:
            self._episodes[index].count_reset()
        remaining = set(options)
        while remaining:
            self._finish_starts(wait_for_all=is_full or self.wait_for_restarts)
            absent = remaining & self._starts.keys()
            answers, failures = self._ask(
                {index: ("reset", (), options[index]) for index in remaining - absent}
            )
            for index, texts in answers.items():
                self._read(index, texts)
                self._lost.discard(index)
            for index in absent:
                self._write(index, _ABSENT)
            self._replace_failed(failures)
            remaining = set(failures)

    def _step_some(self, indices: Sequence[int], inputs: TensorDictBase) -> None:
        self._start_or_replace_dead()
        present = [index for index in indices if index not in self._lost]
        for key in self._slots[0][0].keys(True, True):
            for index in present:
                self._slots[index][0].get(key).copy_(inputs.get(key)[index])
        answers, failures = self._ask({index: ("step", (), {}) for index in present})
        for index, texts in answers.items():
            self._read(index, texts)
            self._failures_in_a_row[index] = 0
            episodes = self._episodes[index]
            episodes.count_fault() if self._rows[index][keys.FAULT] else episodes.count_step()
        self._replace_failed(failures)
        self._finish_starts(wait_for_all=self.wait_for_restarts)
        if len(self._starts) == self.num_workers:
            wait([worker.pipe for worker in self._workers], _START_POLL_S)
        for index in self._lost.intersection(indices):
            self._write(index, _LOST_STEP)

    def _outputs(self) -> TensorDict:
        outputs = self._last.clone()
        for key, texts in self._texts.items():
            outputs.set(key, NonTensorStack(*texts))
        return outputs

    def _seed_one(self, index: int, seed: int | None, static_seed: bool) -> int | None:
        self._start_or_replace_dead()
        while True:
            self._finish_starts(wait_for_all=True)
            self._replaced_since_seed[index] = 0
            answers, failures = self._ask({index: ("set_seed", (seed, static_seed), {})})
            if not failures:
                return answers[index]
            self._replace_failed(failures)

    def _call_each(
        self, method: str, arguments: Iterable[tuple[Any, ...]], **keywords: Any
    ) -> list[Any]:
        return self._ask_all([("call", (method, *own), keywords) for own in arguments])

    def _get_each(self, name: str) -> tuple[list[Any], bool]:
        answers = self._ask_all([("get", (name,), {})] * self.num_workers)
        return [value for value, _ in answers], answers[0][1]

    def _ask_all(self, commands: Sequence[Command], timeout_s: float | None = None) -> list[Any]:
        """Return the answer of each worker."""
        if self.is_closed:
            self.start()
        self._finish_starts(wait_for_all=True)
        answers, failures = self._ask(dict(enumerate(commands)), timeout_s)
        for index, cause in failures.items():
            raise WorkerError(f"worker {index} failed: {cause}")
        return [answers[index] for index in range(self.num_workers)]

    def _ask(
        self, commands: Mapping[int, Command], timeout_s: float | None = None
    ) -> tuple[dict[int, Any], dict[int, WorkerError]]:
        """Send commands to workers and wait for the answers.

        Args:
            commands: by index of the worker.
            timeout_s: seconds to wait; by default as in the options.

        Returns:
            The answers, and the errors of the workers that failed, which are killed; by index.

        Raises:
            Exception: an environment raised it; see `is_of_code`.
        """
        timeout_s = self.workers.timeout_s if timeout_s is None else timeout_s
        for index, command in commands.items():
            self._workers[index].send(*command)
        pending, answers, failures, raised = set(commands), {}, {}, None
        deadline = time.monotonic() + timeout_s
        try:
            while pending:
                handles = [handle for i in pending for handle in self._workers[i].handles]
                is_late = not _wait(handles, deadline - time.monotonic())
                for index in sorted(pending):
                    worker = self._workers[index]
                    try:
                        if worker.has_answer():
                            answers[index] = worker.receive()
                        elif is_late:
                            raise WorkerError(f"it did not answer within {timeout_s:g} s")
                        else:
                            continue
                    except WorkerError as error:
                        failures[index] = error
                        worker.abort()
                    except Exception as error:  # of the environment
                        raised = error
                    pending.discard(index)
        finally:  # after an interrupt, a late answer would be taken for that to the next command
            for index in pending:
                self._workers[index].abort()
        if raised is not None:
            raise raised
        return answers, failures

    def _read(self, index: int, texts: dict[str, Any]) -> None:
        """Copy the answer of a worker from shared memory, into which it writes again later."""
        for key, value in self._slots[index][1].items(True, True):
            self._rows[index][key].copy_(value)
        for key, text in texts.items():
            self._texts[key][index] = text

    def _write(self, index: int, values: Mapping[str, Any]) -> None:
        """Set the flags of an environment without an episode; it keeps its last observation."""
        for key in values.keys() & self._rows[index].keys():
            self._rows[index][key].fill_(values[key])

    # -- workers -----------------------------------------------------------------------------

    def _launch(self, index: int) -> Worker:
        """Start worker ``index`` without waiting for it."""
        make_env = self.create_env_fn[index]
        if not isinstance(make_env, EnvCreator):
            make_env = CloudpickleWrapper(make_env)
        return Worker(make_env, self._slots[index], self.workers)

    def _start_or_replace_dead(self) -> None:
        """Start all workers if there are none; otherwise replace those that have ended."""
        if self.is_closed:
            self.start()
        dead = {}
        for index, worker in enumerate(self._workers):
            try:
                if index not in self._starts:
                    worker.check()
            except WorkerError as error:
                dead[index] = error
        self._replace(dead)

    def _replace_failed(self, failures: Mapping[int, WorkerError]) -> None:
        """Count failures in resets and steps, and replace the workers."""
        for index, cause in sorted(failures.items()):
            self._failures_in_a_row[index] += 1
            self._check_limit(index, self._failures_in_a_row[index], "completing a step", cause)
            episodes = self._episodes[index]
            episodes.count_fault()
            if episodes.in_a_row >= MAX_CONSECUTIVE_FAULTS:
                self._check_limit(index, episodes.in_a_row, "an undisturbed episode", cause)
        self._replace(failures)

    def _replace(self, causes: Mapping[int, WorkerError], attempts: int = 0) -> None:
        """Start new processes in place of failed workers, without waiting for them.

        Args:
            causes: why each worker is replaced, by index.
            attempts: number of failed attempts to start the worker.
        """
        for index, cause in causes.items():
            self._check_limit(index, attempts, "starting", cause)
            self.restarts += 1
            # As text: the traceback in a stored log record would keep the ended worker alive.
            logger.warning(
                "worker %d is replaced (restart %d): %s", index, self.restarts, str(cause)
            )
            self._workers[index].kill()
            self._workers[index] = self._launch(index)
            self._starts[index] = attempts
            self._replaced_since_seed[index] += 1
            self._lost.add(index)

    def _finish_starts(self, *, wait_for_all: bool) -> None:
        """Seed the environments of the new workers that are ready; they must be reset.

        Args:
            wait_for_all: wait until every worker is ready.
        """
        is_any = True
        while self._starts and (wait_for_all or is_any):
            is_any = False
            for index, attempts in tuple(self._starts.items()):
                worker = self._workers[index]
                if not (wait_for_all or worker.has_started_or_failed()):
                    continue
                is_any = True
                try:
                    worker.wait_until_ready()
                    del self._starts[index]
                    if self._replaced_since_seed[index]:
                        _, failures = self._ask(
                            {index: ("set_seed", (self._new_seed(index), True), {})}
                        )
                        self._replace(failures, attempts + 1)
                except ConfigError:
                    worker.abort()  # its answer is read
                    raise
                except WorkerError as error:
                    if self.is_closed and isinstance(error, EnvironmentRaisedError):
                        raise RuntimeError(
                            f"worker {index} could not be started: {error}"
                        ) from None
                    self._replace({index: error}, attempts + 1)

    def _new_seed(self, index: int) -> int:
        """Return an unused seed, which is the same in every repetition of the run."""
        known = self._base_seed is not None
        entropy = [self._base_seed, index, self._replaced_since_seed[index]] if known else None
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def _check_limit(self, index: int, failures: int, success: str, cause: WorkerError) -> None:
        if failures <= self.workers.max_restarts:
            return
        self.close(raise_if_closed=False)
        raise RuntimeError(
            f"worker {index} failed {failures} times without {success}; the last time {cause}. All "
            "workers were closed. Use parallel=False to see the error where it happens, or raise "
            "timeout_s, start_timeout_s or max_restarts"
        )


def _wait(handles: Sequence[Connection | int], timeout_s: float) -> bool:
    """Wait until a handle is ready; return False after the timeout.

    First it polls: on a machine whose cores are busy, a process that blocks continues later.
    """
    start = time.monotonic()
    while not wait(handles, 0):
        elapsed_s = time.monotonic() - start
        if elapsed_s > min(timeout_s, _POLLING_S):
            return bool(wait(handles, max(timeout_s - elapsed_s, 0.0)))
        time.sleep(_POLL_INTERVAL_S)
    return True


def _zeros(*specs: Composite) -> TensorDictBase:
    """Return zeros [num_workers] for the entries of specs, dense if the environments are alike."""
    zeros = specs[0].zero()
    for spec in specs[1:]:
        zeros.update(spec.zero())
    return TensorDict.maybe_dense_stack(zeros.cpu().unbind(0))
