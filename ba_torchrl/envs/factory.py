"""`make` and `make_vector_env`: environments from the id of a task and keywords."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType
from typing import Any

import torch
from torchrl.envs import EnvBase

from ba_torchrl.core.config import WorkerOptions, parse
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.hardware import existing_device
from ba_torchrl.core.plugins import module_names
from ba_torchrl.envs.base import BulletArmEnv
from ba_torchrl.envs.settings import ResolvedEnv, resolve_env
from ba_torchrl.envs.vector.make import make_vector, processes_save_time


def make(task: str | ResolvedEnv, **config: Any) -> BulletArmEnv:
    """Make a TorchRL environment.

    Args:
        task: an id such as "close_loop/block_picking", see `ba_torchrl.list_tasks`; or what
            `resolve_env` returned.
        config: fields of `ba_torchrl.core.env_config.EnvConfig` and of the task's own parameters,
            such as ``robot="kuka"``, ``obs_size=64``, ``seed=0`` or ``expert=True``; and ``device``

    Examples:
        >>> from ba_torchrl import make
        >>> env = make("close_loop/block_reaching", obs_size=64, seed=0)
        >>> steps = env.rollout(3)  # random actions
        >>> steps["depth"].shape, steps["next", "reward"].shape
        (torch.Size([3, 1, 64, 64]), torch.Size([3, 1]))
        >>> env.close()
    """
    return BulletArmEnv(task, **config)


def make_vector_env(
    task: str | ResolvedEnv,
    num_envs: int,
    *,
    workers: WorkerOptions | None = None,
    register_modules: Sequence[str | ModuleType] = (),
    make: Callable[[ResolvedEnv], BulletArmEnv] = make,
    device: torch.device | str | int | None = None,
    **options: Any,
) -> EnvBase:
    """Make ``num_envs`` environments that step together.

    They are one TorchRL environment, in processes that are replaced when they fail, or with
    ``parallel=False`` in this process. The same seed gives the same episodes in both.

    Args:
        task: as for `make`.
        num_envs: how many; environment i has the seed ``seed + i``.
        workers: how they are started, and replaced when they fail.
        register_modules: modules outside the package that each process imports before it makes its
            environment, such as ``["my_tasks"]``. Those that register the task and the robot are
            found without being named.
        make: makes one environment; a function or class that the processes can import.
        device: of the vector's TensorDicts, the CPU by default.
        options: as for `make`, and single fields of `ba_torchrl.core.config.WorkerOptions`, such as
            ``parallel=False`` or ``timeout_s=120``.

    Examples:
        >>> from ba_torchrl import make_vector_env
        >>> env = make_vector_env("close_loop/block_reaching", 2, parallel=False, obs_size=64)
        >>> env.rollout(3, break_when_any_done=False)["action"].shape
        torch.Size([2, 3, 5])
        >>> env.close()
    """
    place = None if device is None else existing_device(device)
    of_workers = {name: options.pop(name) for name in WorkerOptions.model_fields if name in options}
    if not isinstance(workers, WorkerOptions | None):
        raise ConfigError(f"workers: must be WorkerOptions, got {workers!r}")
    given = {} if workers is None else workers.model_dump()
    workers = parse(WorkerOptions, {**given, **of_workers}, "workers")
    resolved = resolve_env(task, options, modules=module_names(register_modules))
    if workers.parallel is None:
        workers = workers.model_copy(update={"parallel": processes_save_time(num_envs)})
    if workers.parallel and workers.start_method == "spawn":
        resolved.check_spawned_process_knows()
    env = make_vector(partial(make, resolved), num_envs, seed=resolved.config.seed, workers=workers)
    env.resolved = resolved
    return env if place is None else env.to(place)
