"""The private names of TorchRL that `VectorEnv` uses, of which any release may remove some."""

from __future__ import annotations

import importlib
import inspect
from functools import cache

from torchrl.envs import batched_envs

MODULE_NAMES = {
    "torchrl.envs.batched_envs": ("_run_worker_pipe_direct", "_run_worker_pipe_shared_mem"),
    "torchrl._utils": ("BATCHED_PIPE_TIMEOUT",),
}
"""Names of modules, by module."""
METHODS = (
    "_create_td",
    "_filter_warnings_subprocess",
    "_reset",
    "_shutdown_workers",
    "_start_workers",
    "_step",
    "_wait_for_workers",
)
"""Methods of ``ParallelEnv`` that are overridden or called."""
ATTRIBUTES = (
    "_last_worker_outputs",
    "_mp_start_method",
    "_non_tensor_keys",
    "_selected_input_keys",
    "_selected_reset_keys",
    "_selected_reset_keys_filt",
    "_selected_step_keys",
    "_shared_tensordict_parent_next",
    "_shared_tensordict_parent_root",
    "_shm_done_flags",
    "_timeout",
    "_use_buffers",
    "parent_channels",
    "shared_tensordict_parent",
    "shared_tensordicts",
)
"""Attributes of an instance."""


@cache
def missing_names() -> tuple[str, ...]:
    """Return the names that the installed TorchRL lacks."""
    source = inspect.getsource(batched_envs)
    missing = [
        f"{module}.{name}"
        for module, names in MODULE_NAMES.items()
        for name in names
        if not hasattr(importlib.import_module(module), name)
    ]
    env = batched_envs.ParallelEnv
    missing += [f"ParallelEnv.{name}" for name in METHODS if not hasattr(env, name)]
    missing += [f"ParallelEnv.{name}" for name in ATTRIBUTES if f"self.{name}" not in source]
    return tuple(missing)
