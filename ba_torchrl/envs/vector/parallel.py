"""VectorEnv: TorchRL's ParallelEnv, with replacement of failed workers."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from ctypes import Array, c_byte
from typing import Any

import torch
from tensordict import NonTensorStack, TensorDictBase
from torch import multiprocessing as mp
from torchrl.data.utils import CloudpickleWrapper
from torchrl.envs import EnvBase, EnvCreator, ParallelEnv
from torchrl.envs.batched_envs import _run_worker_pipe_shared_mem

from ba_torchrl.config import WorkerOptions
from ba_torchrl.envs import keys
from ba_torchrl.envs.positions import Position
from ba_torchrl.envs.vector.batching import SeededVector
from ba_torchrl.envs.vector.replacement import Replacements, seed_worker
from ba_torchrl.envs.vector.worker import EnvironmentRaisedError, Worker, wait_until
from ba_torchrl.errors import WorkerError

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
_ABSENT = {**_LOST_STEP, keys.TRUNCATED: False, keys.DONE: False}
_START_POLL_S = 1.0
_HEALTH_CHECK_S = 5e-3


class VectorEnv(SeededVector, ParallelEnv):
    """Environments in worker processes; a worker that ends or hangs is replaced.

    The other workers keep their episodes, and step while the new worker starts. For the environment
    of the failed worker, the step returns the last valid observation with ``fault``, ``truncated``
    and ``done`` set and a reward of zero; TorchRL then resets it like any environment that is done.
    Actions are validated in this process before they are sent. An error that an environment raises
    is raised in this process, caused by one with the worker's traceback; only the next reset or
    step replaces the worker. Errors of the simulator and of memory replace it at once.

    This reset waits for the new worker, unless ``workers.wait_for_restarts`` is False. Then the
    environment is absent until the worker is ready: the reset returns the last valid observation
    with ``fault`` set, and so does every step, which is truncated and done. A full reset always
    waits.

    Args:
        num_workers: number of environments.
        create_env_fn: builds one environment, or one such function per environment.
        workers: how processes start and when they are replaced.

    Raises:
        ValueError: the environments lack a ``truncated`` or a ``fault`` entry.
    """

    def __init__(
        self,
        num_workers: int,
        create_env_fn: MakeEnv | Sequence[MakeEnv],
        *,
        workers: WorkerOptions = WorkerOptions(),  # noqa: B008 -- immutable
    ) -> None:
        super().__init__(
            num_workers,
            create_env_fn,
            mp_start_method=workers.start_method,
            shutdown_timeout=5.0,
            use_buffers=True,
        )
        missing = {keys.TRUNCATED, keys.FAULT} - {*self.done_keys, *self.observation_keys}
        if missing:
            raise ValueError(f"environments in workers need the entries {sorted(missing)}")
        self.workers, self.wait_for_restarts = workers, workers.wait_for_restarts
        self._lost: set[int] = set()  # without an episode, and the next step reports a fault
        self.parent_channels: list[Worker] = []
        self._replacements = Replacements(
            self.parent_channels, self._launch, self._close_all, workers.max_restarts, num_workers
        )

    @property
    def restarts(self) -> int:
        """Number of workers that were replaced."""
        return self._replacements.restarts

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the workers, by environment."""
        return [worker.process.pid for worker in self.parent_channels]

    def get_positions(self) -> list[Position]:
        """Return the position of each environment; see `SeededVector.get_positions`."""
        if self._lost:
            raise WorkerError(f"the episodes of environments {sorted(self._lost)} are lost")
        arguments = [()] * self.num_workers
        return ask_all(self.parent_channels, "get_position", arguments, self.workers.timeout_s)

    def continue_from(self, positions: Sequence[Position]) -> None:
        """Continue episodes; see `SeededVector.continue_from`."""
        steps = max(sum(map(len, position["actions"])) for position in positions)
        arguments = [(position,) for position in positions]
        self._replacements.finish(wait_for_all=True)
        timeout_s = self.workers.timeout_s + steps * _STEP_S
        ask_all(self.parent_channels, "continue_from", arguments, timeout_s)

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Step, and reset the environments that are done; see `EnvBase.step_and_maybe_reset`."""
        self._check_actions(tensordict)
        with self._stepping():
            step, state = super().step_and_maybe_reset(tensordict)
        if self._has_instruction:
            self._write_instructions(step[keys.NEXT])
            self._read_instructions(step[keys.NEXT, keys.DONE])
            self._write_instructions(state)
        return step, state

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the workers, and keep the number of torch threads, which TorchRL increases."""
        threads = torch.get_num_threads()
        super().close(raise_if_closed=raise_if_closed)
        torch.set_num_threads(threads)

    def __getitem__(self, item: Any) -> EnvBase:
        raise NotImplementedError("a VectorEnv cannot be indexed: its workers may be replaced")

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_actions(tensordict)
        with self._stepping():
            return self._write_instructions(super()._step(tensordict))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if self.is_closed:
            self.start()
        self._replace_dead()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or kwargs:
            with self._waiting():
                self._replacements.finish(wait_for_all=True)
                state = super()._reset(tensordict, **kwargs)
                self._read_instructions(mask)
                return self._write_instructions(state)
        self._replacements.finish(wait_for_all=self.wait_for_restarts)
        if not mask.any():  # TorchRL would fail
            state = self.shared_tensordict_parent.select(*self._selected_reset_keys_filt).clone()
            return self._write_instructions(state)
        with self._muted(self._replacements.starting):
            state = super()._reset(tensordict, **kwargs)
        self._read_instructions(mask)
        return self._write_instructions(state)

    def _create_td(self) -> None:
        """Make the shared memory, which holds tensors only.

        The instruction of an episode is asked of the worker after each reset instead.
        """
        super()._create_td()
        self._has_instruction = keys.INSTRUCTION in self._non_tensor_keys
        self._instructions = [""] * self.num_workers
        if others := set(self._non_tensor_keys) - {keys.INSTRUCTION}:
            raise ValueError(f"workers cannot share {sorted(others)}, which are no tensors")
        self._non_tensor_keys = []

    def _read_instructions(self, is_reset: torch.Tensor | None) -> None:
        """Ask workers for the instructions of new episodes; one that has failed keeps its last.

        Args:
            is_reset: bool [num_workers, 1]; None for all.
        """
        if not self._has_instruction:
            return
        for index, worker in enumerate(self.parent_channels):
            is_new = is_reset is None or bool(is_reset[index].any())
            if is_new and index not in self._replacements.starting:
                with contextlib.suppress(WorkerError):
                    (self._instructions[index],) = ask_all(
                        [worker], keys.INSTRUCTION, [()], self.workers.timeout_s
                    )

    def _write_instructions(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Set the instructions of the present episodes, if they are observed."""
        if self._has_instruction:
            tensordict.set(keys.INSTRUCTION, NonTensorStack(*self._instructions))
        return tensordict

    def _seed_env(self, index: int, seed: int) -> None:
        self._replacements.on_seed(index)
        self._replacements.finish(wait_for_all=True)
        worker = self.parent_channels[index]
        try:
            worker.check()
            seed_worker(worker, seed)
        except WorkerError as error:
            self._replacements.begin({index: error}, seed)
            self._replacements.finish(wait_for_all=True)
            self._lost.add(index)

    def _set_base_seed(self, seed: int | None) -> None:
        super()._set_base_seed(seed)
        self._replacements.base_seed = self._base_seed

    def _start_workers(self) -> None:
        # TorchRL raises if a process in `_workers` has ended; here it is replaced instead.
        self._workers: list[Any] = []
        self._timeout = self.shutdown_timeout
        self._shm_done_flags = mp.RawArray("b", self.num_workers)
        self._lost.clear()
        self.event = None  # TorchRL's CUDA event; these environments are on the CPU
        try:
            for index in range(self.num_workers):
                self.parent_channels.append(self._launch(index))
            failures = {}
            for index, worker in enumerate(self.parent_channels):
                try:
                    worker.wait_until_ready()
                except EnvironmentRaisedError as error:
                    raise RuntimeError(f"worker {index} could not be started: {error}") from None
                except WorkerError as error:
                    failures[index] = error
            self._replacements.begin(failures, failures=1)
            self._replacements.finish(wait_for_all=True)
        except BaseException:
            for worker in self.parent_channels:
                worker.kill()
            self._forget_workers()
            raise
        self.is_closed = False
        self.set_spec_lock_()

    def _launch(self, index: int) -> Worker:
        """Start worker ``index`` without waiting for it."""
        make_env = self.create_env_fn[index]
        if not isinstance(make_env, EnvCreator | CloudpickleWrapper):
            make_env = CloudpickleWrapper(make_env)
        self._shm_done_flags[index] = 0
        options = {
            "env_fun": make_env,
            "env_fun_kwargs": self.create_env_kwargs[index],
            "num_threads": self.num_sub_threads,
            "filter_warnings": self._filter_warnings_subprocess(),
            "worker_idx": index,
            "shm_done_flags": self._shm_done_flags,
            "shared_tensordict": self.shared_tensordicts[index],
            "_selected_input_keys": self._selected_input_keys,
            "_selected_reset_keys": self._selected_reset_keys,
            "_selected_step_keys": self._selected_step_keys,
            "_non_tensor_keys": self._non_tensor_keys,
        }
        limits = self._mp_start_method, self.workers.timeout_s, self.workers.start_timeout_s
        return Worker(_run_worker_pipe_shared_mem, options, *limits)

    @property
    def _events(self) -> list[Any]:
        return [worker.event for worker in self.parent_channels]

    def _shutdown_workers(self) -> None:
        for index, worker in enumerate(self.parent_channels):
            if index in self._replacements.starting:
                worker.abort()
                continue
            worker.muted = False
            worker.send(("close", None))
        deadline = time.monotonic() + self.shutdown_timeout
        for worker in self.parent_channels:
            worker.join(deadline - time.monotonic())
        self._forget_workers()
        del self.shared_tensordicts, self.shared_tensordict_parent
        del self._shared_tensordict_parent_next, self._shared_tensordict_parent_root

    def _forget_workers(self) -> None:
        self.parent_channels.clear()
        self._replacements.forget_starts()

    def _close_all(self) -> None:
        if not self.is_closed:  # else `_start_workers` ends them
            self.close()

    @contextlib.contextmanager
    def _stepping(self) -> Iterator[None]:
        """Context of a step: workers that ended since the last command report a fault."""
        if self.is_closed:
            self.start()
        self._replace_dead()
        with self._muted(self._lost):
            yield

    @contextlib.contextmanager
    def _muted(self, indices: Iterable[int]) -> Iterator[None]:
        """Context in which some workers get no commands."""
        for index in indices:
            self.parent_channels[index].muted = True
        try:
            yield
        finally:
            for worker in self.parent_channels:
                worker.muted = False

    @contextlib.contextmanager
    def _waiting(self) -> Iterator[None]:
        """Context in which resets wait for workers that start."""
        waits, self.wait_for_restarts = self.wait_for_restarts, True
        try:
            yield
        finally:
            self.wait_for_restarts = waits

    def _replace_dead(self) -> None:
        """Replace the workers that have ended since their last answer."""
        dead = {}
        for index, worker in enumerate(self.parent_channels):
            if not worker.is_ready:
                continue
            try:
                worker.check()
            except WorkerError as error:
                dead[index] = error
        self._replacements.begin(dead)
        self._lost |= dead.keys()

    def _wait_for_workers(self, workers_range: Iterable[int]) -> None:
        messages = {index: self.parent_channels[index].message for index in workers_range}
        absent = {index for index in messages if self.parent_channels[index].muted}
        for index in absent:
            self.parent_channels[index].muted = False
        failures = self._collect([index for index in messages if index not in absent])
        answered = messages.keys() - absent - failures.keys()
        for index in answered:
            self._lost.discard(index)
            if messages[index][0] != "reset":
                self._replacements.count_step(index)
        self._replace_failed(failures)
        if len(self._replacements.starting) == self.num_workers:
            self._replacements.wait_for_any(_START_POLL_S)
            self._replacements.finish(wait_for_all=False)
        for index in sorted(messages.keys() - answered):
            self._recover(index, messages[index])

    def _replace_failed(self, failures: dict[int, WorkerError]) -> None:
        for index, cause in failures.items():
            self._replacements.count_failure(index, cause)
        self._replacements.begin(failures)
        self._replacements.finish(wait_for_all=self.wait_for_restarts)

    def _collect(self, indices: list[int]) -> dict[int, WorkerError]:
        """Wait for the answers of workers; return the errors of failed workers by index."""
        pending = set(indices)
        failures: dict[int, WorkerError] = {}
        deadline = time.monotonic() + self.workers.timeout_s
        try:
            while pending:
                failed = collect_flags(self.parent_channels, pending, self._shm_done_flags)
                if time.monotonic() > deadline:
                    late = f"it did not finish within {self.workers.timeout_s:g} s"
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
        self._lost.add(index)
        if command != "reset":
            self._write(index, _LOST_STEP, to_next=True)
            message = ("reset", (False, {}))
        if command == "step":  # the environment is done, so the caller resets it
            if index not in self._replacements.starting:
                self._lost.discard(index)
            return
        while index not in self._replacements.starting:
            # The message contains the seed, if the caller gave one.
            self.parent_channels[index].send(message)
            failures = self._collect([index])
            if not failures:
                self._lost.discard(index)
                return
            self._replace_failed(failures)
        self._write(index, _ABSENT, to_next=False)

    def _write(self, index: int, values: dict[str, Any], *, to_next: bool) -> None:
        """Write the answer of an environment without a worker: its last observation, and flags.

        Args:
            index: of the environment.
            values: of the flags and the reward.
            to_next: answer a step, otherwise a reset.
        """
        root = self.shared_tensordicts[index]
        answer = root
        if to_next:
            answer = root.get("next")
            for key in set(self.observation_keys) - {keys.INSTRUCTION}:
                answer.get(key).copy_(root.get(key))
        for key in values.keys() & set(answer.keys()):
            answer.get(key).fill_(values[key])


def collect_flags(
    workers: Sequence[Worker], pending: set[int], flags: Array[c_byte]
) -> dict[int, WorkerError]:
    """Wait briefly for the workers' answers, which are in shared memory.

    Args:
        workers: all workers.
        pending: indices of those that have not answered; those that answer are removed.
        flags: set by the workers.

    Returns:
        The errors of ended workers, by index.
    """

    def all_answered() -> bool:
        for index in tuple(pending):
            if flags[index]:
                flags[index] = 0
                pending.discard(index)
        return not pending

    failures: dict[int, WorkerError] = {}
    if wait_until(all_answered, _HEALTH_CHECK_S):
        return failures
    for index in pending:
        try:
            workers[index].check()
        except WorkerError as error:
            if not flags[index]:  # else it answered before it ended
                failures[index] = error
    return failures


def ask_all(
    workers: Sequence[Worker], method: str, arguments: Sequence[tuple[Any, ...]], timeout_s: float
) -> list[Any]:
    """Call a method of every worker's environment and return the results.

    Args:
        workers: all workers.
        method: name of the method.
        arguments: of each worker's call.
        timeout_s: seconds to wait for each answer.

    Raises:
        WorkerError: a worker has failed.
        Exception: an environment raised it.
    """
    for worker, args in zip(workers, arguments, strict=True):
        worker.check()
        worker.send((method, (args, {})))
    results, failure = [], None
    for worker in workers:
        try:
            results.append(worker.read(timeout_s)[1])
        except Exception as error:
            worker.abort()  # a late answer would be taken for that to the next command
            failure = error
    if failure is not None:
        raise failure
    return results
