"""Benchmark: a grid of tasks, algorithms, networks and seeds, which a launcher runs."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import Field

from ba_torchrl.core.config import Chosen, LocalPath, Seed, StrictModel, parse
from ba_torchrl.core.errors import ConfigError, OtherRunError, UnknownNameError
from ba_torchrl.core.plugins import load_plugins
from ba_torchrl.record.results import (
    CONFIG_FILE,
    RESULT_FILE,
    flat,
    read_failure,
    read_result,
)
from ba_torchrl.tasks.base import TASKS, Versions
from ba_torchrl.training.config import ExperimentConfig
from ba_torchrl.training.grid.launchers.base import LAUNCHERS, LauncherConfig

if TYPE_CHECKING:
    from ba_torchrl.algorithms.base import Problem

SET_BY_THE_GRID = ("task", "seed", "label", "run_dir", "resume", "benchmark")
"""Fields of `ExperimentConfig` that differ from run to run."""

Overrides = dict[str, dict[str, Any]]
Preset = Callable[[Literal["algorithm", "network"], str], dict[str, Any]]
"""From a group and a name to the values of that preset file; raises with the known names."""
State = Literal["done", "running", "interrupted", "failed", "missing", "unreadable", "other"]
"""State of a run. "other": its folder holds a run with other settings."""


class BenchmarkConfig(StrictModel):
    """A grid of runs. Its lists are the grid's axes; all other fields are overrides."""

    name: str
    """Of the benchmark, for reports."""
    folder: LocalPath
    """Of all its runs."""
    tasks: list[str] = Field(min_length=1)
    """Ids of tasks."""
    algorithms: list[str] = Field(min_length=1)
    """Methods: names of preset files in ``configs/algorithm``, each followed by those in
    ``configs/replay`` and ``configs/rotation`` that differ from "uniform" and "none":
    "sacfd_per_so2"."""
    networks: list[str] = Field(min_length=1)
    """Names of preset files in ``configs/network``."""
    variants: list[str] = Field(default_factory=lambda: [""], min_length=1)
    """Names of settings in `per_variant`, a further axis; the empty name changes nothing."""
    seeds: Annotated[int, Field(ge=1, le=1000)] | list[Seed] = 4
    """A number of seeds, from 0 on, or a list of seeds."""
    skip: list[dict[str, str | list[str]]] = Field(default_factory=list)
    """Runs to leave out: each entry gives a name or a list of names for ``task``, ``algorithm``,
    ``network``, ``variant`` or several of these; runs that match all of them are left out."""
    per_task: Overrides = Field(default_factory=dict)
    """By task, fields that override those common to all runs."""
    per_algorithm: Overrides = Field(default_factory=dict)
    """By algorithm; overrides `per_task`."""
    per_network: Overrides = Field(default_factory=dict)
    """By network; overrides `per_algorithm`."""
    per_variant: Overrides = Field(default_factory=dict)
    """By variant; overrides `per_network`. "{task}" in ``demonstrations_path`` is the task's id."""
    launcher: Annotated[LauncherConfig, Chosen(LAUNCHERS)] = Field(
        default={"name": "local"}, validate_default=True
    )
    """``name`` of a registered launcher and its options: where the runs take place."""
    jobs: int = Field(default=1, ge=1)
    """Runs at the same time; on a Ray cluster, its resources decide."""
    max_hours: float | None = Field(default=None, gt=0)
    """Time limit of a run. A run that exceeds it is stopped and counts as failed; the next call
    resumes it."""

    def seed_list(self) -> list[int]:
        """Return the seeds of the grid."""
        return list(range(self.seeds)) if isinstance(self.seeds, int) else self.seeds

    def skips(self, **cell: str) -> bool:
        """Whether the grid leaves out a cell.

        Args:
            cell: its ``task``, ``algorithm``, ``network`` and ``variant``.
        """
        return any(
            all(
                cell[axis] in ([names] if isinstance(names, str) else names) for axis, names in rule
            )
            for rule in (entry.items() for entry in self.skip)
        )


Benchmark = TypeVar("Benchmark", bound=BenchmarkConfig)


def split(values: Mapping[str, Any], model: type[Benchmark]) -> tuple[Benchmark, dict[str, Any]]:
    """Return the grid that composed settings describe, and the fields that its runs share.

    Raises:
        ConfigError: a field of the grid has a wrong type or is out of range.
    """
    own = {name: value for name, value in values.items() if name in model.model_fields}
    common = {name: value for name, value in values.items() if name not in own}
    return parse(model, own, "benchmark"), common


@dataclass(frozen=True)
class Status:
    """State of a run of the grid."""

    state: State
    detail: str = ""
    seconds: float | None = None
    """Wall time of a run that is done."""

    def __str__(self) -> str:
        return f"{self.state}: {' '.join(self.detail.split())}" if self.detail else self.state


def plan(
    config: BenchmarkConfig, common: Mapping[str, Any], preset: Preset
) -> list[ExperimentConfig]:
    """Return every run of a grid, after one environment and learner of each kind was made.

    Args, order and errors are as in `expand`.
    """
    runs = expand(config, common, preset)
    _check_parts(runs[: len(runs) // len(config.seed_list())])  # other seeds have the same parts
    return runs


def expand(
    config: BenchmarkConfig, common: Mapping[str, Any], preset: Preset
) -> list[ExperimentConfig]:
    """Return every run of a grid: all tasks and methods with the first seed come first.

    Args:
        config: the grid.
        common: fields of `ExperimentConfig` that all runs share. ``algorithm`` and ``network`` hold
            fields without a ``name``, which override every preset's.
        preset: loads the presets.

    Returns:
        `ExperimentConfig` of each run.

    Raises:
        ConfigError: a name is unknown, a value cannot be used, or parts do not go together.
    """
    load_plugins(common.get("plugins", ()))
    preset = functools.cache(preset)
    _check_axes(config, preset)
    presets = {
        (group, name): preset(group, name)
        for group, names in (("algorithm", config.algorithms), ("network", config.networks))
        for name in names
    }
    cells = []
    for task, algorithm, network, variant in product(
        config.tasks, config.algorithms, config.networks, config.variants
    ):
        if config.skips(task=task, algorithm=algorithm, network=network, variant=variant):
            continue
        given = _merged(
            common,
            config.per_task.get(task, {}),
            config.per_algorithm.get(algorithm, {}),
            config.per_network.get(network, {}),
            config.per_variant.get(variant, {}),
        )
        chosen = {
            "algorithm": presets["algorithm", algorithm],
            "network": presets["network", network],
        }
        values = _merged(chosen, given)
        taken = [name for name in SET_BY_THE_GRID if name in values]
        if taken:
            raise ConfigError(f"{', '.join(taken)}: set by the benchmark; leave it out")
        for axis in chosen:
            other = given.get(axis)
            if isinstance(other, Mapping) and "name" in other:  # labels have the names of the axis
                name = f"{axis}.name={other['name']}"
                raise ConfigError(f"{name}: set by the benchmark; write {axis}s=[{other['name']}]")
        if isinstance(path := values.get("demonstrations_path"), str):
            values["demonstrations_path"] = path.replace("{task}", task)
        label = " ".join(filter(None, (algorithm, network, variant)))
        names = (name.replace("/", "_").replace(" ", "_") for name in (task, label))
        values |= {
            "task": task,
            "label": label,
            "benchmark": config.name,
            "run_dir": str(Path(config.folder, *names)),
            "resume": True,
        }
        try:
            cells.append(ExperimentConfig.parse(values, given=flat(given)))
        except ConfigError as error:
            raise ConfigError(f"{task} with {label}: {error}") from None
    runs = [
        cell.model_copy(update={"seed": seed, "run_dir": str(cell.folder / f"seed{seed}")})
        for seed in config.seed_list()
        for cell in cells
    ]
    if not runs:
        raise ConfigError("the grid is empty: `skip` leaves everything out")
    owners: dict[Path, ExperimentConfig] = {}
    for run in runs:
        other = owners.setdefault(run.folder, run)
        if other is not run:
            names = " and ".join(f"{each.task} with {each.label}" for each in (other, run))
            raise ConfigError(f"{names} have the same run folder {run.folder}: use two grids")
    return runs


def status(run: ExperimentConfig) -> Status:
    """Return the state of a run, whatever its folder holds."""
    try:
        return _status(run)
    except OtherRunError as error:
        return Status("other", str(error))
    except (ConfigError, OSError) as error:
        return Status("unreadable", f"{error}; delete {run.folder} to start the run again")


def _status(run: ExperimentConfig) -> Status:
    from ba_torchrl.training.checkpoint import (
        check_same_run,
        parse_saved,
        read_config,
        resumable_updates,
        run_holder,
    )

    folder = run.folder
    if (folder / RESULT_FILE).exists():
        result = read_result(folder)
        # settings that are newer than the run have their defaults
        started = parse_saved(result.config, folder / RESULT_FILE, device=run.device)
        check_same_run(run, started, Versions(result.task_version, result.expert_version))
        success = f"success {result.last.success_rate:.2f}"
        return Status("done", success, result.seconds)
    if (folder / CONFIG_FILE).exists():
        check_same_run(run, read_config(folder, device=run.device))
    holder = run_holder(folder)
    if holder is not None:
        return Status("running", holder)
    reason = read_failure(folder)
    if reason is not None:
        return Status("failed", reason)
    if (folder / CONFIG_FILE).exists():
        updates = resumable_updates(folder) or 0
        return Status("interrupted", f"continues after update {updates} of {run.total_updates}")
    return Status("missing")


def _check_axes(config: BenchmarkConfig, preset: Preset) -> None:
    """Refuse unknown and repeated names on every axis, and unknown ones in every override."""
    known: dict[str, Callable[[str], Any]] = {
        "task": TASKS.__getitem__,
        "algorithm": lambda name: preset("algorithm", name),
        "network": lambda name: preset("network", name),
        "variant": functools.partial(_known_variant, config),
    }
    axes = {
        "task": config.tasks,
        "algorithm": config.algorithms,
        "network": config.networks,
        "variant": config.variants,
    }
    for axis, names in (*axes.items(), ("seed", config.seed_list())):
        if len(set(names)) < len(names) or not names:
            raise ConfigError(f"{axis}s: {names} is empty or names one twice")
    for axis, names in (*axes.items(), *_mentioned(config)):
        if axis not in known:
            raise ConfigError(f"skip: unknown axis {axis!r}. Known: {', '.join(known)}")
        for name in names:
            known[axis](name)


def _known_variant(config: BenchmarkConfig, name: str) -> None:
    if name and name not in config.per_variant:
        raise UnknownNameError("variant", name, config.per_variant, "per_variant has its settings.")


def _mentioned(config: BenchmarkConfig) -> Iterator[tuple[str, Sequence[str]]]:
    """Yield (axis, names) of the overrides and of ``skip``."""
    yield "task", list(config.per_task)
    yield "algorithm", list(config.per_algorithm)
    yield "network", list(config.per_network)
    for entry in config.skip:
        for axis, names in entry.items():
            yield axis, [names] if isinstance(names, str) else names


def _check_parts(runs: Sequence[ExperimentConfig]) -> None:
    """Make every environment and every learner of the grid once.

    Tasks and robots check some parameters, networks some sizes and actions.
    """
    import torch

    from ba_torchrl.training.learner import build_learner, problem_of

    problems: dict[str, Problem] = {}
    built = set()
    for run in runs:
        key = repr(run.env)
        try:
            if key not in problems:
                problem = problem_of(run)
                # equal except for what no network depends on
                images = {name: replace(image, high=1.0) for name, image in problem.images.items()}
                cpu = torch.device("cpu")
                problems[key] = replace(problem, images=images, seed=0, device=cpu)
            problem = problems[key]
            learner = repr((problem, run.algorithm, run.network))
            if learner not in built:
                built.add(learner)
                build_learner(run, problem)
        except ConfigError as error:
            raise ConfigError(f"{run.task} with {run.label}: {error}") from None


def _merged(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested settings, later ones over earlier ones."""
    out: dict[str, Any] = {}
    for layer in layers:
        for key, value in layer.items():
            if isinstance(value, Mapping):
                before = out.get(key)
                out[key] = _merged(before if isinstance(before, Mapping) else {}, value)
            else:
                out[key] = copy.copy(value)
    return out
