"""The untrained learner of a run, and what it must know of the environment."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from ba_torchrl.algorithms.base import Learner, Problem
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.factory import make
from ba_torchrl.training.config import ExperimentConfig

_LEAST_LIMIT, _TIMES = 10_000_000, 50
"""Most parameters of a learner whose weights are read from a file: this number, or for larger files
this many for each byte. A file of a policy alone has two bytes for each weight, and no critics."""


def build_learner(config: ExperimentConfig, problem: Problem | None = None) -> Learner:
    """Build the untrained learner of an experiment, of a `problem_of` that may be known already.
    `ConfigError` if task, algorithm and network do not go together."""
    problem = problem or problem_of(config)
    torch.manual_seed(config.seed)
    return _build(config, problem)


def build_to_load(config: ExperimentConfig, file: Path, size: int) -> Learner:
    """Build a learner with an empty replay, whose weights will be replaced; torch's generators do
    not change.

    Args:
        config: which somebody else may have written.
        file: that has the configuration and the weights, for the message.
        size: of the file in bytes.

    Raises:
        ConfigError: task, algorithm and network do not go together, or the learner would take many
            times the size of the file.
    """
    device, algorithm = config.torch_device, config.algorithm
    replay = algorithm.replay.model_copy(update={"capacity": 1})
    small = config.model_copy(update={"algorithm": algorithm.model_copy(update={"replay": replay})})
    with (
        torch.device("cpu"),
        torch.random.fork_rng([device] if device.type == "cuda" else []),
        _limited(max(_LEAST_LIMIT, _TIMES * size), file),
    ):
        return _build(small, problem_of(small))


@contextmanager
def _limited(limit: int, file: Path) -> Iterator[None]:
    """Context in which modules have no more parameters than a limit; beyond it, `ConfigError` comes
    before the parameter's memory is used."""
    left = limit

    def count(_: nn.Module, __: str, parameter: nn.Parameter | None) -> None:
        nonlocal left
        left -= 0 if parameter is None else parameter.numel()
        if left < 0:
            raise ConfigError(
                f"{file} does not hold the weights of its settings, which describe networks with "
                f"more than {limit:,} parameters"
            )

    handle = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        handle.remove()


def _build(config: ExperimentConfig, problem: Problem) -> Learner:
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)  # of the observations
    try:
        return config.algorithm.build(config.network, problem)
    except ConfigError:
        raise
    except ValueError as error:  # sizes and components that a network does not take
        raise ConfigError(str(error)) from error
    finally:
        torch.set_default_dtype(dtype)


def problem_of(config: ExperimentConfig) -> Problem:
    """Return what the learner of an experiment must know of its environment."""
    env = make(config.env.without_window())
    env.close()
    task_class = config.env.task_class
    return Problem(
        control=task_class.control,
        equal_moves=task_class.equal_moves,
        images=env.images,
        vectors=env.vectors,
        center_m=config.env.workspace.center,
        actions=env.actions,
        total_updates=config.total_updates,
        seed=config.seed,
        device=config.torch_device,
    )
