"""The untrained learner of a run, and what it must know of the environment."""

from __future__ import annotations

import torch

from ba_torchrl.algorithms.base import Learner, Problem
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.factory import make
from ba_torchrl.training.config import ExperimentConfig


def build_learner(config: ExperimentConfig, problem: Problem | None = None) -> Learner:
    """Build the untrained learner of an experiment, of a `problem_of` that may be known already.
    `ConfigError` if task, algorithm and network do not go together."""
    problem = problem or problem_of(config)
    torch.manual_seed(config.seed)
    return _build(config, problem)


def build_to_load(config: ExperimentConfig) -> Learner:
    """Build a learner whose weights will be replaced; torch's generators do not change."""
    device = config.torch_device
    with torch.device("cpu"), torch.random.fork_rng([device] if device.type == "cuda" else []):
        return _build(config, problem_of(config))


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
    env = make(config.env)
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
