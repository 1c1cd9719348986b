"""Resuming: the saved state of a run, from which an interrupted run continues.

Saved: the algorithm (networks, optimiser, schedules, generators), its replay with priorities, the
process's random number generators, the learning curve, all counters, and the position of every
environment in its episode. On a CPU, a resumed run therefore continues bit for bit, and repeats
what came after the last save. If a worker process had failed when the state was saved, the episodes
in progress are replaced by episodes of other seeds.
"""

from __future__ import annotations

import logging
import shutil
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

from torchrl.checkpoint import CheckpointRotation, GlobalRNGState

from ba_torchrl.algorithms.base import Learner
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.envs.episode_positions import EpisodePosition
from ba_torchrl.record.results import CONFIG_FILE, RESULT_FILE, CurvePoint, Phase, differences
from ba_torchrl.tasks.base import Versions, versions_of
from ba_torchrl.training.checkpoint import read_config, read_versions, write_config
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.persistence import (
    DurableCheckpoint,
    first_sound,
    remove_leftovers,
    saved_steps,
    step_of,
)

logger = logging.getLogger(__name__)

RECENT_EPISODES = 100
KEPT_STATES = 2
_FOLDER = "resume"


@dataclass
class Progress:
    """Learning curve and counters of a run."""

    curve: list[CurvePoint] = field(default_factory=list)
    recent: deque[bool] = field(default_factory=lambda: deque(maxlen=RECENT_EPISODES))
    """Whether each of the latest training episodes reached the goal."""
    env_steps: int = 0
    faults: int = 0
    demonstrations: int = 0
    """Episodes of demonstrations."""
    demonstration_steps: int = 0
    expert_version: int | None = None
    """Of the expert that played demonstrations or labels states; None of no or an unknown one."""
    expert_labels: int = 0
    """States of the collection that the expert labelled and the replay stored."""
    phase_seconds: dict[Phase, float] = field(
        default_factory=lambda: dict.fromkeys(get_args(Phase), 0.0)
    )
    """Wall time by phase."""
    precisions: list[str] = field(default_factory=list)
    """Number formats in which the networks computed; several after a move to another machine."""
    resumed_at: list[int] = field(default_factory=list)
    """Updates after which the run was resumed."""
    pending_updates: int = 0
    """Updates still to be taken for the last step of collection."""
    positions: list[EpisodePosition] | None = None
    """Position of each environment in its episodes; None before the collection starts."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        values = {name: value for name, value in vars(self).items() if name != "curve"}
        curve = [point.model_dump() for point in self.curve]
        return {**values, "recent": list(self.recent), "curve": curve}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        vars(self).update(state)
        self.recent = deque(state["recent"], maxlen=RECENT_EPISODES)
        self.curve = [CurvePoint(**point) for point in state["curve"]]


class ResumeState:
    """The state that a run saves regularly and deletes when it finishes; it is large.

    Each state gets its final name when it is complete on the disk, with checksums of its files. The
    last two are kept: if the newest is damaged, the run continues from the one before.

    Args:
        folder: the run folder.
        algorithm: whose state and replay are saved.
        progress: the run's counters and curve.
    """

    def __init__(self, folder: Path, algorithm: Learner, progress: Progress) -> None:
        self._folder = folder / _FOLDER
        self._checkpoint = DurableCheckpoint(
            algorithm=algorithm,
            replay=SimpleNamespace(
                state_dict=algorithm.replay_state, load_state_dict=algorithm.load_replay_state
            ),
            progress=progress,
            generators=_Generators(),
        )
        self._rotation = CheckpointRotation(self._folder, keep_last=KEPT_STATES)

    def save(self, updates: int) -> None:
        """Write the state of a run after so many updates."""
        self._rotation.save(self._checkpoint, step=updates)

    def load(self) -> bool:
        """Restore the newest state whose files are whole; return whether there is any state.

        Raises:
            ConfigError: all states are damaged, or hold files that are not plain data.
        """
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
        shutil.rmtree(self._folder, ignore_errors=True)


def resumable_updates(folder: str | Path) -> int | None:
    """Return the update after which the run in a folder can be resumed, None if it cannot."""
    folder = Path(folder) / _FOLDER
    states = saved_steps(folder)
    return step_of(states[0]) if states else None


def open_run_folder(config: ExperimentConfig) -> None:
    """Make the run folder and write the configuration into it.

    Raises:
        ConfigError: it holds a run that is finished, or that has other settings, or that
            ``resume`` does not ask for; the message names the reason.
    """
    folder = config.folder
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
            if (folder / "checkpoints").exists():
                raise ConfigError(
                    f"{folder} has checkpoints, but nothing to resume from; choose another run_dir"
                )
            logger.warning("the run in %s has no saved state yet: starting it again", folder)
    write_config(config)


def check_same_run(config: ExperimentConfig) -> None:
    """Check that the run in the folder of ``config`` has the same settings, task and expert.

    The device may differ, and that of the folder need not exist on this machine.

    Raises:
        ConfigError: it has not; the message names every difference.
    """
    started = read_config(config.folder, device=config.device)
    found = differences(started.resolved(), config.resolved())
    if found:
        lines = [f"{name}: {old!r} there, {new!r} now" for name, (old, new) in found.items()]
        raise ConfigError(
            f"the run in {config.folder} was started with other settings:\n  " + "\n  ".join(lines)
        )
    check_same_versions(config, read_versions(config.folder))


def check_same_versions(config: ExperimentConfig, there: Versions) -> None:
    """Check that the run in the folder of ``config`` has the present versions of task and expert.

    Args:
        config: of the run.
        there: its versions; an expert that is not known, or took no part, may be any.

    Raises:
        ConfigError: it has others.
    """
    here = versions_of(config.task)
    if there.task != here.task or there.expert not in (None, here.expert):
        raise ConfigError(
            f"the run in {config.folder} was started with {there} of {config.task}, here are "
            f"{here}: choose another folder, or use the package that started it"
        )


class _Generators(GlobalRNGState):
    """The process's generators; those of a GPU are restored only where there are as many GPUs."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        here = self.state_dict()
        found = {name: value for name, value in state_dict.items() if name in here}
        cuda = "torch_cuda"
        if cuda in found and len(found[cuda]) != len(here[cuda]):
            del found[cuda]
        if len(found) < len(state_dict):
            logger.warning("another device: %s not restored", ", ".join(state_dict.keys() - found))
        super().load_state_dict(found)
