"""VectorEnv: TorchRL's ParallelEnv, with replacement of failed workers."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import multiprocessing as mp
from torchrl.data.utils import CloudpickleWrapper
from torchrl.envs import EnvBase, EnvCreator, ParallelEnv
from torchrl.envs.batched_envs import _run_worker_pipe_direct, _run_worker_pipe_shared_mem

from ba_torchrl.envs import keys
from ba_torchrl.envs.positions import Position
from ba_torchrl.envs.vector.answers import ask_all, collect_flags, collect_messages
from ba_torchrl.envs.vector.batching import SeededVector
from ba_torchrl.envs.vector.worker import Worker
from ba_torchrl.errors import WorkerError

logger = logging.getLogger(__name__)

MakeEnv = Callable[[], EnvBase]

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


class VectorEnv(SeededVector, ParallelEnv):
    """Environments in worker processes; a worker that raises, ends or hangs is replaced.

    The other workers keep their episodes. For the environment of the failed worker, the step
    returns the last valid observation with ``fault``, ``truncated`` and ``done`` set and a reward
    of zero; TorchRL then resets it like any environment that is done. Actions are validated in this
    process before they are sent. ``restarts`` counts the replacements.

    Args:
        num_workers: number of environments.
        create_env_fn: builds one environment, or one such function per environment.
        timeout_s: seconds after which a worker that does not answer is replaced.
        max_restarts: largest number of failures in a row of a worker: of attempts to start it, or
            of resets and steps without a completed step. The end of an idle worker does not count.
        start_timeout_s: seconds after which a worker that does not start is replaced.
        parallel_options: further options of `torchrl.envs.ParallelEnv`.

    Raises:
        ValueError: the environments lack a ``truncated`` or a ``fault`` entry.
    """

    def __init__(
        self,
        num_workers: int,
        create_env_fn: MakeEnv | Sequence[MakeEnv],
        *,
        timeout_s: float = 60.0,
        max_restarts: int = 5,
        start_timeout_s: float = 120.0,
        **parallel_options: Any,
    ) -> None:
        parallel_options.setdefault("shutdown_timeout", 5.0)
        super().__init__(num_workers, create_env_fn, **parallel_options)
        missing = {keys.TRUNCATED, keys.FAULT} - {*self.done_keys, *self.observation_keys}
        if missing:
            raise ValueError(f"environments in workers need the entries {sorted(missing)}")
        self.timeout_s = timeout_s
        self.max_restarts = max_restarts
        self.start_timeout_s = start_timeout_s
        self.restarts = 0
        self._failures_in_a_row = [0] * num_workers
        self._replacements = [0] * num_workers  # since the last seed
        self._lost: set[int] = set()  # replaced between two steps, fault not reported yet
        self._threads_before = torch.get_num_threads()
        self.parent_channels: list[Worker] = []

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the workers, by environment."""
        return [worker.process.pid for worker in self.parent_channels]

    def get_positions(self) -> list[Position]:
        """Return the position of each environment; see `SeededVector.get_positions`."""
        arguments = [()] * self.num_workers
        return ask_all(self.parent_channels, "get_position", arguments, self.timeout_s)

    def continue_from(self, positions: Sequence[Position]) -> None:
        """Continue episodes; see `SeededVector.continue_from`."""
        steps = max(sum(map(len, position["actions"])) for position in positions)
        arguments = [(position,) for position in positions]
        timeout_s = self.timeout_s + steps * _STEP_S
        ask_all(self.parent_channels, "continue_from", arguments, timeout_s)

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Step, and reset the environments that are done; see `EnvBase.step_and_maybe_reset`."""
        if not self._use_buffers:
            return super().step_and_maybe_reset(tensordict)  # calls _step and _reset
        self._check_actions(tensordict)
        with self._stepping():
            return super().step_and_maybe_reset(tensordict)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the workers and restore the number of torch threads."""
        was_open, threads = not self.is_closed, torch.get_num_threads()
        super().close(raise_if_closed=raise_if_closed)
        if was_open:
            # TorchRL increases the number, assuming that it decreased it at the start.
            torch.set_num_threads(threads if self.num_threads is None else self._threads_before)

    def __getitem__(self, item: Any) -> EnvBase:
        raise NotImplementedError("a VectorEnv cannot be indexed: its workers may be replaced")

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_actions(tensordict)
        with self._stepping():
            return super()._step(tensordict)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if self.is_closed:
            self.start()
        self._replace_dead()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if self._use_buffers and mask is not None and not mask.any():  # TorchRL would fail
            return self.shared_tensordict_parent.select(*self._selected_reset_keys_filt).clone()
        return super()._reset(tensordict, **kwargs)

    def _seed_env(self, index: int, seed: int) -> None:
        self._replacements[index] = 0
        worker = self.parent_channels[index]
        try:
            worker.check()
            _seed(worker, seed)
        except WorkerError as error:
            self._replace({index: error}, seed)
            self._lost.add(index)

    def _start_workers(self) -> None:
        if self._use_buffers and self._non_tensor_keys:
            raise ValueError(f"use_buffers=False is needed for {self._non_tensor_keys}")
        # TorchRL raises if a process in `_workers` has ended; here it is replaced instead.
        self._workers: list[Any] = []
        self._timeout = self.shutdown_timeout
        self._shm_done_flags = mp.RawArray("b", self.num_workers)
        self._lost.clear()
        self.event = None  # TorchRL's CUDA event; these environments are on the CPU
        try:
            for index in range(self.num_workers):
                self.parent_channels.append(self._launch(index))
            for index, worker in enumerate(self.parent_channels):
                try:
                    worker.wait_until_ready()
                except WorkerError as error:
                    raise RuntimeError(f"worker {index} could not be started: {error}") from None
        except BaseException:
            for worker in self.parent_channels:
                worker.kill()
            self.parent_channels = []
            raise
        self._threads_before = torch.get_num_threads()
        if self.num_threads is not None:
            torch.set_num_threads(self.num_threads)
        self.is_closed = False
        self.set_spec_lock_()

    def _launch(self, index: int) -> Worker:
        """Start worker ``index`` without waiting for it."""
        make_env = self.create_env_fn[index]
        if not isinstance(make_env, EnvCreator | CloudpickleWrapper):
            make_env = CloudpickleWrapper(make_env)
        options = {
            "env_fun": make_env,
            "env_fun_kwargs": self.create_env_kwargs[index],
            "num_threads": self.num_sub_threads,
            "filter_warnings": self._filter_warnings_subprocess(),
        }
        limits = self._mp_start_method, self.timeout_s, self.start_timeout_s
        if not self._use_buffers:
            options["consolidate"] = self.consolidate
            return Worker(_run_worker_pipe_direct, options, *limits)
        self._shm_done_flags[index] = 0
        options |= {
            "worker_idx": index,
            "shm_done_flags": self._shm_done_flags,
            "shared_tensordict": self.shared_tensordicts[index],
            "_selected_input_keys": self._selected_input_keys,
            "_selected_reset_keys": self._selected_reset_keys,
            "_selected_step_keys": self._selected_step_keys,
            "_non_tensor_keys": self._non_tensor_keys,
        }
        return Worker(_run_worker_pipe_shared_mem, options, *limits)

    @property
    def _events(self) -> list[Any]:
        return [worker.event for worker in self.parent_channels]

    def _shutdown_workers(self) -> None:
        for worker in self.parent_channels:
            worker.muted = False
            worker.send(("close", None))
        deadline = time.monotonic() + self.shutdown_timeout
        for worker in self.parent_channels:
            worker.join(deadline - time.monotonic())
        self.parent_channels = []
        if self._use_buffers:
            del self.shared_tensordicts, self.shared_tensordict_parent
            del self._shared_tensordict_parent_next, self._shared_tensordict_parent_root

    @contextlib.contextmanager
    def _stepping(self) -> Iterator[None]:
        """Context of a step: workers that ended since the last command report a fault."""
        if self.is_closed:
            self.start()
        self._replace_dead()
        for index in self._lost:
            self.parent_channels[index].muted = True
        try:
            yield
        finally:
            for worker in self.parent_channels:
                worker.muted = False

    def _replace_dead(self) -> None:
        """Replace the workers that have ended since their last answer."""
        dead = {}
        for index, worker in enumerate(self.parent_channels):
            try:
                worker.check()
            except WorkerError as error:
                dead[index] = error
        self._replace(dead)
        self._lost |= dead.keys()

    def _count_failure(self, index: int, cause: WorkerError) -> None:
        """Count a failure in a reset or a step.

        Raises:
            RuntimeError: there were too many without a completed step.
        """
        self._failures_in_a_row[index] += 1
        self._check_limit(index, self._failures_in_a_row[index], "completing a step", cause)

    def _check_limit(self, index: int, failures: int, success: str, cause: WorkerError) -> None:
        if failures <= self.max_restarts:
            return
        self.close()
        raise RuntimeError(
            f"worker {index} failed {failures} times without {success}; the last time {cause}. All "
            "workers were closed. Use parallel=False to see the error where it happens, or raise "
            "timeout_s, start_timeout_s or max_restarts"
        )

    def _replace(self, causes: Mapping[int, WorkerError], seed: int | None = None) -> None:
        """Start and seed new processes, all at once; they must be reset before a step.

        Args:
            causes: why each worker is replaced, by index.
            seed: None for unused ones.

        Raises:
            RuntimeError: a worker cannot be started.
        """
        attempts = 0
        while causes:
            for index, cause in causes.items():
                self._check_limit(index, attempts, "starting", cause)
                self.restarts += 1
                self._replacements[index] += 1
                # As text: the traceback in a stored log record would keep the ended worker alive.
                logger.warning(
                    "worker %d is replaced (restart %d): %s", index, self.restarts, str(cause)
                )
                self.parent_channels[index].kill()
                self.parent_channels[index] = self._launch(index)
            attempts += 1
            failed = {}
            for index in causes:
                worker = self.parent_channels[index]
                try:
                    worker.wait_until_ready()
                    _seed(worker, self._new_seed(index) if seed is None else seed)
                except WorkerError as error:
                    failed[index] = error
            causes = failed

    def _new_seed(self, index: int) -> int:
        """Return an unused seed, which is the same in every repetition of the run."""
        known = self._base_seed is not None
        entropy = [self._base_seed, index, self._replacements[index]] if known else None
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def _wait_for_workers(self, workers_range: Iterable[int]) -> None:
        workers = {index: self.parent_channels[index] for index in workers_range}
        failures = self._collect([index for index in workers if not workers[index].muted])
        for index, cause in failures.items():
            self._count_failure(index, cause)
        self._replace(failures)
        for index, worker in workers.items():
            if index not in failures and not worker.muted and worker.command != "reset":
                self._failures_in_a_row[index] = 0
            if index in failures or worker.muted:
                self._recover(index, worker.message)
            self._lost.discard(index)

    def _collect(self, indices: list[int]) -> dict[int, WorkerError]:
        """Wait for the answers of workers; return the errors of failed workers by index."""
        pending = set(indices)
        failures: dict[int, WorkerError] = {}
        deadline = time.monotonic() + self.timeout_s
        try:
            while pending:
                workers = self.parent_channels
                if self._use_buffers:
                    failed = collect_flags(workers, pending, self._shm_done_flags)
                else:
                    failed = collect_messages(workers, pending)
                if time.monotonic() > deadline:
                    late = f"it did not finish within {self.timeout_s:g} s"
                    failed = {index: WorkerError(late) for index in pending} | failed
                failures |= failed
                pending -= failed.keys()
        except BaseException:
            # After an interrupt, a late answer would be taken for the answer to the next command.
            for index in pending:
                self.parent_channels[index].abort()
            raise
        return failures

    def _recover(self, index: int, message: tuple[Any, Any]) -> None:
        """Answer the command in ``message`` for an environment that lost its episode."""
        command = message[0]
        if command != "reset":
            self._write_lost_step(index)
            message = ("reset", (False, {}))
        self.parent_channels[index].muted = False
        if command == "step":  # the environment is done, so the caller resets it
            return
        while True:
            # The message contains the seed, if the caller gave one.
            self.parent_channels[index].send(message)
            failures = self._collect([index])
            if not failures:
                return
            self._count_failure(index, failures[index])
            self._replace(failures)

    def _write_lost_step(self, index: int) -> None:
        """Write the answer to a step that was lost."""
        if self._use_buffers:
            root = self.shared_tensordicts[index]
            answer = root.get("next")
        else:
            root = self._last_worker_outputs[index]
            answer = TensorDict(device=self.device)
            for spec in (self.full_observation_spec, self.full_reward_spec, self.full_done_spec):
                answer.update(spec[index].zero())
            self.parent_channels[index].inbox.append(answer)
        if root is not None:
            for key in self.observation_keys:
                answer.get(key).copy_(root.get(key))
        for key in _LOST_STEP.keys() & set(answer.keys()):
            answer.get(key).fill_(_LOST_STEP[key])


def _seed(worker: Worker, seed: int) -> None:
    worker.send(("seed", (seed, True)))
    worker.recv()
