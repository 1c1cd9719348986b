"""Files of a run: configuration, the lock on its folder, checkpoints, and the state to resume from.

Checkpoints and states survive a loss of power, and are checked before they are loaded. A state has
the learner (networks, optimiser, schedules, generators), its replay with priorities, the
process's random number generators, the learning curve, all counters, and the position of every
environment in its episode. On a CPU, a resumed run therefore continues bit for bit, and repeats
what came after the last save. If a worker process had failed when the state was saved, the episodes
in progress are replaced by episodes of other seeds.
"""

from __future__ import annotations

import json
import logging
import math
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointAdapter,
    CheckpointError,
    CheckpointLoadResult,
    CheckpointRotation,
    GlobalRNGState,
)

from ba_torchrl import __version__
from ba_torchrl.algorithms.base import Learner
from ba_torchrl.algorithms.config import ALGORITHMS
from ba_torchrl.core.config import Which
from ba_torchrl.core.errors import ConfigError, DamagedFilesError, OtherRunError, check_choice
from ba_torchrl.core.files import (
    OLD,
    RENAMED,
    Lock,
    atomic_output,
    errors_naming,
    lock_holder,
    read_json,
    read_state,
    remove_scratch,
    verify_checksums,
    write_checksums,
    write_state,
    write_text,
)
from ba_torchrl.core.plugins import check_known
from ba_torchrl.record.results import CONFIG_FILE, RESULT_FILE, differences
from ba_torchrl.tasks.base import Versions, versions_of
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.learner import build_to_load
from ba_torchrl.training.state import RunState

logger = logging.getLogger(__name__)

LOCK_FILE = "run.lock"
_CHECKPOINTS, _RESUME = "checkpoints", "resume"
_VERSIONS = ("task_version", "expert_version")
"""Entries of a run's configuration file that are no settings."""

# -- the run folder ----------------------------------------------------------------------------


def lock_run(folder: Path) -> Lock:
    """Lock a run folder, which is created if needed; `ConfigError` names the process that holds the
    lock."""
    folder.mkdir(parents=True, exist_ok=True)
    return Lock(folder / LOCK_FILE, f"runs the experiment in {folder}")


def run_holder(folder: Path) -> str | None:
    """Return the process that runs the experiment in a folder; see `lock_holder`."""
    return lock_holder(folder / LOCK_FILE)


def open_run_folder(config: ExperimentConfig) -> None:
    """Make the run folder and write the configuration into it. `ConfigError` if it holds another
    run, a finished one, or one that is not to be resumed."""
    folder = config.folder
    remove_scratch(folder)
    if (folder / CONFIG_FILE).exists():
        if (folder / RESULT_FILE).exists():
            raise ConfigError(f"{folder} holds a finished run; choose another run_dir")
        if not config.resume:
            raise ConfigError(
                f"{folder} holds a run that did not finish: resume=true continues it, another "
                "run_dir starts a new one"
            )
        check_same_run(config)
        if resumable_updates(folder) is None:
            if (folder / _CHECKPOINTS).exists():
                raise ConfigError(
                    f"{folder} has checkpoints, but nothing to resume from; choose another run_dir"
                )
            logger.warning("the run in %s has no saved state yet: starting it again", folder)
    write_config(config)


def check_same_run(
    config: ExperimentConfig, started: ExperimentConfig | None = None, there: Versions | None = None
) -> None:
    """Check that the run in the folder of ``config`` has the same settings, task and expert.

    The device may differ, and the folder's device need not exist on this machine.

    Args:
        config: of the run.
        started: its configuration there; None to read it.
        there: its versions; None to read them. An expert that is not known, or took no part, may
            be any.

    Raises:
        OtherRunError: it has not; the message names every difference.
    """
    started = started or read_config(config.folder, device=config.device)
    found = differences(started.resolved(), config.resolved())
    if found:
        lines = [f"{name}: {old!r} there, {new!r} now" for name, (old, new) in found.items()]
        raise OtherRunError(
            f"the run in {config.folder} was started with other settings; choose another folder, "
            "or continue it as it was by run_dir= and resume=true alone:"
            + "\n  ".join(["", *lines])
        )
    there, here = there or read_versions(config.folder), versions_of(config.task)
    if there.task != here.task or there.expert not in (None, here.expert):
        raise OtherRunError(
            f"the run in {config.folder} was started with {there} of {config.task}, here are "
            f"{here}: choose another folder, or use the package that started it"
        )


def write_config(config: ExperimentConfig) -> None:
    """Write configuration and versions of a run; the file appears when it is complete."""
    config.folder.mkdir(parents=True, exist_ok=True)
    versions = dict(zip(_VERSIONS, versions_of(config.task), strict=True))
    text = json.dumps({**versions, **config.model_dump(mode="json")}, indent=2)
    write_text(config.folder / CONFIG_FILE, text + "\n")


def read_config(folder: str | Path, **changes: Any) -> ExperimentConfig:
    """Return the configuration of a run folder with ``changes``; plugins that it names are not
    imported."""
    saved = _read(folder)
    values = {name: value for name, value in saved.items() if name not in _VERSIONS}
    return parse_saved(values, Path(folder) / CONFIG_FILE, **changes)


def read_versions(folder: str | Path) -> Versions:
    """Return the versions of task and expert with which the run in a folder was started."""
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


def parse_saved(
    saved: dict[str, Any], file: str | Path, acting: Mapping[str, Any] | None = None, **changes: Any
) -> ExperimentConfig:
    """Return the configuration that a file holds with ``changes``; plugins that it names are not
    imported, and must be known (`check_known`).

    Args:
        saved: the configuration.
        file: where it is from.
        acting: other values of fields of the algorithm that the policy acts by.
        changes: other values of fields.
    """
    if "plugins" not in changes:
        check_known(saved.get("plugins"), file)
    try:
        config = ExperimentConfig.parse({**saved, **changes}, what=str(file))
    except ConfigError as error:
        raise ConfigError(f"this version cannot use {file}: {error}") from None
    if not acting:
        return config
    if other := sorted(acting.keys() - config.algorithm.acting):
        known = ", ".join(sorted(config.algorithm.acting)) or "none"
        name = ALGORITHMS.name_of(type(config.algorithm))
        raise ConfigError(
            f"algorithm.{other[0]} cannot be set for a trained policy of {name}; fields that it "
            f"acts by: {known}"
        )
    changes["algorithm"] = {**saved["algorithm"], **acting}
    return ExperimentConfig.parse({**saved, **changes}, what="settings")


# -- checkpoints -------------------------------------------------------------------------------


class _StateAdapter(CheckpointAdapter):
    """Writes a component's ``state_dict`` with `write_state`."""

    adapter_id = "ba_torchrl.state.3"
    # 1: weights of kernels whose signs depended on the CPU; 2: images under other keys

    def save(self, component: Any, path: Path, **_: Any) -> None:
        write_state(path, component.state_dict())

    def load(self, component: Any, path: Path, **_: Any) -> None:
        component.load_state_dict(read_state(path))


class DurableCheckpoint(Checkpoint):
    """TorchRL's checkpoint as a folder of data that appears when it is complete on the disk.

    Args:
        components: what is saved, by name: each has ``state_dict`` and ``load_state_dict``.
    """

    def __init__(self, **components: Any) -> None:
        super().__init__()
        for name, component in components.items():
            self.register(name, component, adapter=_StateAdapter())

    def save(self, path: str | Path, **options: Any) -> Path:
        """Write a checkpoint; see TorchRL."""
        path = Path(path)
        with errors_naming(path), atomic_output(path, replace=True) as scratch:
            super().save(scratch, **options)
            write_checksums(scratch)
        return path

    def load(self, path: str | Path, **options: Any) -> CheckpointLoadResult:
        """Check and load a checkpoint; see TorchRL.

        Raises:
            DamagedFilesError: a file is missing, altered or shorter than written.
            ConfigError: a file is neither safetensors nor JSON, or its content does not fit the
                components.
        """
        verify_checksums(path)
        try:
            return super().load(path, **options)
        except (CheckpointError, OSError, ValueError, KeyError, TypeError) as error:
            reason = " ".join(str(error).split())
            if "ba_torchrl.state.2" in reason:
                reason = f"{RENAMED}; train again"
            raise ConfigError(
                f"{path} does not fit this version or configuration: {reason}"
            ) from error

    @classmethod
    def manifest(cls, path: str | Path) -> dict[str, Any]:
        """Read the manifest of a checkpoint; see TorchRL."""
        try:
            return super().manifest(path)
        except AttributeError as error:  # TorchRL expects that the file holds a mapping
            raise CheckpointError(f"{path}: the manifest is not a mapping") from error


def saved_steps(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder of TorchRL's `CheckpointRotation`, the newest first.

    Those that cannot be read are included.
    """
    found = (path for path in folder.glob("checkpoint-*") if step_of(path) is not None)
    return sorted(found, key=step_of, reverse=True)


def step_of(path: Path) -> int | None:
    """Return the step of a checkpoint's folder, None if its name has none."""
    step = path.name.removeprefix("checkpoint-")
    return int(step) if step.isdigit() else None


def remove_leftovers(folder: Path) -> None:
    """Delete what an interrupted save left in a folder of checkpoints.

    A checkpoint that was about to be replaced by one of the same step gets its name back.
    """
    for replaced in folder.glob(f".checkpoint-*{OLD}"):
        checkpoint = folder / replaced.name.removeprefix(".").removesuffix(OLD)
        if not checkpoint.exists():
            os.replace(replaced, checkpoint)
    for leftover in folder.glob(".checkpoint-*"):
        if leftover.is_dir():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()


def first_sound(paths: Iterable[Path]) -> Path | None:
    """Return the first of some checkpoints whose files are whole, None if none is.

    A warning names each one that is passed over.
    """
    for path in paths:
        try:
            verify_checksums(path)
        except DamagedFilesError as error:
            logger.warning("%s: passed over for the one before: %s", path.name, error)
        else:
            return path
    return None


class Checkpoints:
    """The checkpoints of a run folder: the latest ones and the best.

    Each gets its final name when it is complete on the disk, with checksums of its files.
    """

    def __init__(self, folder: Path, learner: Learner, keep_last: int = 2) -> None:
        self._folder = folder
        self._checkpoint = DurableCheckpoint(algorithm=learner)
        remove_leftovers(folder / _CHECKPOINTS)
        self._rotation = CheckpointRotation(
            folder / _CHECKPOINTS, keep_last=keep_last, keep_best=("success_rate", "max")
        )
        self._rotation.prune()  # the process may have been killed after its last save

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
        """Whether there is a checkpoint of the policy of an update."""
        return any(step_of(path) == updates for path in self._rotation.checkpoints())

    def find(self, which: Which) -> Path:
        """Return the folder of the latest or the best checkpoint; see `find_checkpoint`."""
        return find_checkpoint(self._folder, which)

    def load(self, path: Path) -> None:
        """Put the learner into the state of a checkpoint."""
        self._checkpoint.load(path)


def find_checkpoint(path: str | Path, which: Which = "best") -> Path:
    """Return the folder of a checkpoint.

    Args:
        path: a run folder, or one of its checkpoints.
        which: of the checkpoints of a run folder: "best" in evaluation, or "latest". One with
            damaged files is passed over with a warning.

    Raises:
        ConfigError: there is none whose files are whole, or ``which`` is something else.
    """
    check_choice("which", which, Which)
    path = Path(path)
    if (path / _CHECKPOINTS).is_dir():
        saved = saved_steps(path / _CHECKPOINTS)
        if which == "best":  # the newest of equal ones
            saved = sorted(saved, key=_success_rate, reverse=True)
        found = first_sound(saved)
        if found is not None:
            return found
        if saved:
            raise ConfigError(f"all checkpoints of {path} are damaged; see the warnings above")
    if path.parent.name == _CHECKPOINTS and path.exists():
        return path
    raise ConfigError(
        f"{path} is neither a run folder with checkpoints nor one of its checkpoints; "
        "a run folder holds config.json and checkpoints/"
    )


def _success_rate(checkpoint: Path) -> float:
    """Return the success rate of a checkpoint, infinity if it cannot be read.

    It is then examined first, and the warning names it.
    """
    try:
        return float(DurableCheckpoint.manifest(checkpoint)["metadata"]["success_rate"])
    except (CheckpointError, OSError, ValueError, KeyError, TypeError):
        return math.inf


def load(
    path: str | Path, which: Which = "best", **changes: Any
) -> tuple[ExperimentConfig, Learner]:
    """Rebuild the learner of a checkpoint.

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
    size = sum(file.stat().st_size for file in checkpoint.rglob("*"))
    learner = build_to_load(config, checkpoint, size)
    DurableCheckpoint(algorithm=learner).load(checkpoint)
    return config, learner


# -- the state to resume from ------------------------------------------------------------------


class ResumeState:
    """The state that a run saves regularly and deletes when it finishes; it is large.

    Each state gets its final name when it is complete on the disk, with checksums of its files. The
    last two are kept: if the newest is damaged, the run continues from the one before.
    """

    def __init__(self, folder: Path, learner: Learner, state: RunState) -> None:
        self._folder = folder / _RESUME
        self._checkpoint = DurableCheckpoint(
            algorithm=learner,
            replay=SimpleNamespace(
                state_dict=learner.replay_state, load_state_dict=learner.load_replay_state
            ),
            progress=state,
            generators=_Generators(),
        )
        self._rotation = CheckpointRotation(self._folder, keep_last=2)

    def save(self, updates: int) -> None:
        """Write the state of a run after its latest update, whose number is given."""
        self._rotation.save(self._checkpoint, step=updates)

    def load(self) -> bool:
        """Restore the newest state whose files are whole; return whether there is any state.
        `ConfigError` if all are damaged."""
        remove_leftovers(self._folder)
        states = saved_steps(self._folder)
        if not states:
            return False
        sound = first_sound(states)
        if sound is None:
            raise ConfigError(
                f"all states in {self._folder} are damaged: start the run again in another "
                "run_dir, or evaluate its checkpoints"
            )
        self._checkpoint.load(sound)
        for damaged in states[: states.index(sound)]:
            shutil.rmtree(damaged)
        return True

    def remove(self) -> None:
        """Delete the state of a finished run."""
        shutil.rmtree(self._folder.resolve(), ignore_errors=True)  # it may be a link


def resumable_updates(folder: str | Path) -> int | None:
    """Return the update after which the run in a folder can be resumed, None if it cannot."""
    states = saved_steps(Path(folder) / _RESUME)
    return step_of(states[0]) if states else None


class _Generators(GlobalRNGState):
    """The process's generators; a GPU's generator is restored only where there are as many GPUs."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        here = self.state_dict()
        found = {name: value for name, value in state_dict.items() if name in here}
        cuda = "torch_cuda"
        if cuda in found and len(found[cuda]) != len(here[cuda]):
            del found[cuda]
        if len(found) < len(state_dict):
            logger.warning("another device: %s not restored", ", ".join(state_dict.keys() - found))
        super().load_state_dict(found)
