"""Checkpoints of a run, and the configuration from which they are rebuilt."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, get_args

import torch
from torchrl.checkpoint import CheckpointError, CheckpointRotation

from ba_torchrl import __version__
from ba_torchrl.algorithms.base import Learner, Problem
from ba_torchrl.core.config import Which
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.files import read_json, write_text
from ba_torchrl.core.plugins import check_known
from ba_torchrl.envs.factory import make
from ba_torchrl.record.results import CONFIG_FILE
from ba_torchrl.tasks.base import Versions, versions_of
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.persistence import (
    DurableCheckpoint,
    first_sound,
    remove_leftovers,
    saved_steps,
    step_of,
)

_VERSIONS = ("task_version", "expert_version")
"""Entries of a run's configuration file that are no settings."""


class Checkpoints:
    """The checkpoints of a run folder: the latest ones and the best.

    Each gets its final name when it is complete on the disk, with checksums of its files.

    Args:
        folder: the run folder.
        algorithm: what to save.
        keep_last: how many of the latest to keep.
    """

    def __init__(self, folder: Path, algorithm: Learner, keep_last: int = 2) -> None:
        self._folder = folder
        self._checkpoint = DurableCheckpoint(algorithm=algorithm)
        remove_leftovers(folder / "checkpoints")
        self._rotation = _rotation(folder, keep_last)

    def save(self, updates: int, success_rate: float) -> Path:
        """Write a checkpoint and return its folder."""
        metadata = {
            "updates": updates,
            "success_rate": success_rate,
            "ba_torchrl": __version__,
            "torch": torch.__version__,
        }
        return Path(self._rotation.save(self._checkpoint, step=updates, metadata=metadata))

    def has(self, updates: int) -> bool:
        """Whether there is a checkpoint of the policy after so many updates."""
        return any(step_of(path) == updates for path in self._rotation.checkpoints())

    def find(self, which: Which) -> Path:
        """Return the folder of the latest or the best checkpoint; see `find_checkpoint`."""
        return find_checkpoint(self._folder, which)

    def load(self, path: Path) -> None:
        """Put the algorithm into the state of a checkpoint."""
        self._checkpoint.load(path)


def write_config(config: ExperimentConfig) -> None:
    """Write configuration and versions of a run; the file appears when it is complete."""
    config.folder.mkdir(parents=True, exist_ok=True)
    versions = dict(zip(_VERSIONS, versions_of(config.task), strict=True))
    text = json.dumps({**versions, **config.model_dump(mode="json")}, indent=2)
    write_text(config.folder / CONFIG_FILE, text + "\n")


def read_config(folder: str | Path, **changes: Any) -> ExperimentConfig:
    """Read the configuration of a run folder. Plugins that it names are not imported.

    Args:
        folder: the run folder.
        changes: fields to override.

    Raises:
        ConfigError: there is none, it does not parse, or it names plugins that are neither imported
            nor installed.
    """
    saved = _read(folder)
    values = {name: value for name, value in saved.items() if name not in _VERSIONS}
    return parse_saved(values, Path(folder) / CONFIG_FILE, **changes)


def read_versions(folder: str | Path) -> Versions:
    """Return the versions of task and expert with which the run in a folder was started.

    Raises:
        ConfigError: there is no run, or it does not say them.
    """
    saved = _read(folder)
    found = [saved.get(name) for name in _VERSIONS]
    if not all(isinstance(version, int) for version in found):
        raise ConfigError(
            f"{Path(folder) / CONFIG_FILE} has no {' and '.join(_VERSIONS)}; train again"
        )
    return Versions(*found)


def _read(folder: str | Path) -> dict[str, Any]:
    file = Path(folder) / CONFIG_FILE
    try:
        return dict(read_json(file))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise ConfigError(f"cannot read {file}: {error}") from None


def parse_saved(saved: dict[str, Any], file: str | Path, **changes: Any) -> ExperimentConfig:
    """Return the configuration that a file holds. Plugins that it names are not imported.

    Args:
        saved: the configuration.
        file: that holds it.
        changes: fields to override.

    Raises:
        ConfigError: it does not parse, or it names plugins that are neither imported nor installed.
    """
    plugins = saved.get("plugins")
    if isinstance(plugins, list) and "plugins" not in changes:
        check_known(map(str, plugins), file)
    try:
        return ExperimentConfig.parse({**saved, **changes}, what=str(file))
    except ConfigError as error:
        raise ConfigError(f"this version cannot use {file}: {error}") from None


def find_checkpoint(path: str | Path, which: Which = "best") -> Path:
    """Return the folder of a checkpoint.

    Args:
        path: a run folder, or one of its checkpoints.
        which: of the checkpoints of a run folder: "best" in evaluation, or "latest". One with
            damaged files is passed over with a warning.

    Raises:
        ConfigError: there is none whose files are whole, or ``which`` is something else.
    """
    if which not in get_args(Which):
        raise ConfigError(f"which: {which!r} is none of {', '.join(get_args(Which))}")
    path = Path(path)
    if (path / "checkpoints").is_dir():
        saved = saved_steps(path / "checkpoints")
        if which == "best":  # the newest of equal ones
            saved = sorted(saved, key=_success_rate, reverse=True)
        found = first_sound(saved)
        if found is not None:
            return found
        if saved:
            raise ConfigError(f"all checkpoints of {path} are damaged; see the warnings above")
    if path.parent.name == "checkpoints" and path.exists():
        return path
    raise ConfigError(
        f"{path} is neither a run folder with checkpoints nor one of its checkpoints; "
        "a run folder holds config.json and checkpoints/"
    )


def load(
    path: str | Path, which: Which = "best", **changes: Any
) -> tuple[ExperimentConfig, Learner]:
    """Rebuild the algorithm of a checkpoint.

    Args:
        path: a run folder, or one of its checkpoints.
        which: of the checkpoints of a run folder: "best" in evaluation, or "latest".
        changes: fields of `ExperimentConfig` to override, such as ``device="cpu"`` for a run that
            was trained on a GPU.

    Raises:
        ConfigError: there is no checkpoint, its files are damaged or are not plain data, or its
            configuration does not parse.
    """
    checkpoint = find_checkpoint(path, which)
    config = read_config(checkpoint.parent.parent, **changes)
    algorithm = build_algorithm(config)
    DurableCheckpoint(algorithm=algorithm).load(checkpoint)
    return config, algorithm


def build_algorithm(config: ExperimentConfig, problem: Problem | None = None) -> Learner:
    """Build the untrained algorithm of an experiment.

    Args:
        config: of the experiment.
        problem: what `problem_of` returns for it, if that is known.

    Raises:
        ConfigError: task, algorithm and network do not go together.
    """
    problem = problem or problem_of(config)
    torch.manual_seed(config.seed)
    try:
        return config.algorithm_config.build(config.network_config, problem)
    except ConfigError:
        raise
    except ValueError as error:  # sizes and components that a network does not take
        raise ConfigError(str(error)) from error


def problem_of(config: ExperimentConfig) -> Problem:
    """Return what the algorithm of an experiment must know of its environment.

    Raises:
        ConfigError: the environment cannot be made.
    """
    env = make(config.resolved_env)
    env.close()
    return Problem(
        control=config.resolved_env.task_class.control,
        images=env.images,
        vectors=env.vectors,
        center_m=config.resolved_env.workspace.center,
        actions=env.actions,
        total_updates=config.total_updates,
        pretrain_updates=config.pretrain_updates,
        seed=config.seed,
        device=config.torch_device,
    )


def _success_rate(checkpoint: Path) -> float:
    """Return the success rate of a checkpoint, infinity if it cannot be read.

    It is then examined first, and the warning names it.
    """
    try:
        return float(DurableCheckpoint.manifest(checkpoint)["metadata"]["success_rate"])
    except (CheckpointError, OSError, ValueError, KeyError, TypeError):
        return math.inf


def _rotation(folder: Path, keep_last: int) -> CheckpointRotation:
    return CheckpointRotation(
        folder / "checkpoints", keep_last=keep_last, keep_best=("success_rate", "max")
    )
