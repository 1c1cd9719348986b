"""The diagnosis of a policy as a folder: a page, tables (CSV, Markdown) and pictures."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ba_torchrl.core.files import write_text
from ba_torchrl.record.plots import plot_failure
from ba_torchrl.record.report import write_csv, write_page
from ba_torchrl.record.results import now
from ba_torchrl.record.statistics import wilson
from ba_torchrl.record.summary import markdown, pipes
from ba_torchrl.testing.diagnosis import KINDS, Diagnosis, Failure, StateRow
from ba_torchrl.testing.labels import JUMP_DEG, JUMP_MM, LAST_BITS, Offset

PAGE = "diagnosis.html"
_DEFINITIONS = (
    "The failing state of an episode is the first of its states from which the expert needs the "
    "fewest steps to the goal. Offsets are from the expert's exact action, in open loop of the "
    "target and in close loop of the displacement: the median, and in the table of states also the "
    "90th percentile. A rounded action is the nearest one on the policy's grid. Successes are "
    "counts of failing states from which the goal is reached with the task's full number of "
    "steps: by the expert, by the expert with rounded actions, by the expert after one action of "
    "the policy, and by the policy. Label jumps: states in which the expert's action changes by "
    f"more than {JUMP_MM:g} mm or {JUMP_DEG:g}°, or to another primitive, as arm and bodies "
    f"move by {LAST_BITS:g} m and rad."
)


class _Table(NamedTuple):
    """A table of texts."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]

    def __str__(self) -> str:
        return "\n\n".join([f"{self.title}:", "\n".join(pipes(self.headings, *self.rows))])


def write_diagnosis(found: Diagnosis, folder: Path, policy: str, pictures: int) -> str:
    """Write the page, the tables and the pictures; return the tables in Markdown.

    Args:
        found: the diagnosis.
        folder: new or empty.
        policy: name of the policy, for the page.
        pictures: most pictures of each kind of failure.
    """
    folder.mkdir(parents=True, exist_ok=True)
    summary = _summary(found)
    tables = [table for table in (_failures(found), _states(found)) if table.rows]
    write_csv(folder / "failures.csv", [_failure_row(failure) for failure in found.failures])
    write_csv(folder / "states.csv", [_state_row(row) for row in found.states])
    panels: dict[str, list[dict[str, str]]] = {kind: [] for kind in KINDS}
    for (kind, _), failures in _grouped(found.failures, _kind_and_stage):
        for failure in failures[:pictures]:
            name = f"failure_{failure.seed}.png"
            plot_failure(failure.picture, folder / name)
            panels[kind].append({"file": name, "caption": _caption(failure)})
    write_page(
        folder / PAGE,
        task=found.task,
        policy=policy,
        summary=summary,
        definitions=_DEFINITIONS,
        tables=tables,
        kinds={f"{kind}: {KINDS[kind]}": shown for kind, shown in panels.items() if shown},
        made=now(),
    )
    text = "\n\n".join([markdown(summary), *map(str, tables)])
    write_text(folder / "table.md", f"{text}\n\n{_DEFINITIONS}\n")
    return text


def _summary(found: Diagnosis) -> str:
    """Return the result of all episodes as a sentence."""
    if not found.episodes:
        return f"{found.faults} episodes of {found.task}, all with a simulator fault."
    _, low, high = wilson(found.solved / found.episodes, found.episodes)
    text = f"{found.solved} of {found.episodes} episodes of {found.task} are solved"
    text += f" (95 % interval {low:.2f} to {high:.2f})"
    if found.faults:
        text += f"; {found.faults} more had a simulator fault"
    return f"{text}."


def _grouped(items: Iterable[Any], key: Callable[[Any], Any]) -> list[tuple[Any, list[Any]]]:
    """Return the items by key, the largest group first."""
    groups: dict[Any, list[Any]] = defaultdict(list)
    for item in items:
        groups[key(item)].append(item)
    return sorted(groups.items(), key=lambda pair: (-len(pair[1]), pair[0]))


def _kind_and_stage(failure: Failure) -> tuple[str, str]:
    return failure.kind, failure.stage.name


def _failures(found: Diagnosis) -> _Table:
    """Return the table of the failures, by kind and stage."""
    who = list(found.failures[0].successes) if found.failures else []
    has_grid = bool(found.failures) and found.failures[0].rounded is not None
    headings = ["failure", "stage", "episodes", "expert's steps to the goal", "policy's offset"]
    headings += ["rounded expert's offset"] if has_grid else []
    headings += [f"{name} succeeds" for name in who] + ["label jumps"]
    rows = []
    for (kind, _), failures in _grouped(found.failures, _kind_and_stage):
        count = len(failures)
        row = [kind, _stages(failures), str(count), _steps(failures)]
        row.append(_medians([failure.policy for failure in failures]))
        if has_grid:
            row.append(_medians([failure.rounded for failure in failures]))
        row += [f"{sum(failure.successes[name] for failure in failures)}/{count}" for name in who]
        row.append(f"{sum(failure.jumps for failure in failures)}/{count}")
        rows.append(row)
    return _Table("Failures, in their failing states", headings, rows)


def _states(found: Diagnosis) -> _Table:
    """Return the table of all states, by stage."""
    has_grid = bool(found.states) and found.states[0].rounded is not None
    ends = ["x, y, z (mm)", "distance (mm)", "rotation (°)"]
    headings = ["stage", "states", *(f"policy's {end}" for end in ends), "other primitive"]
    headings += [f"rounded expert's {end}" for end in ends[1:]] if has_grid else []
    rows = []
    for stage, states in _grouped(found.states, lambda state: state.stage):
        offsets = [state.policy for state in states]
        sides = np.median(np.abs([offset[:3] for offset in offsets]), axis=0)
        row = [stage, str(len(states)), ", ".join(f"{side:.1f}" for side in sides)]
        row += _spreads(offsets)
        row.append(_share(offset.is_other_primitive for offset in offsets))
        if has_grid:
            row += _spreads([state.rounded for state in states])
        rows.append([*row, _share(state.jumps for state in states)])
    return _Table("All states", [*headings, "label jumps"], rows)


def _stages(failures: Sequence[Failure]) -> str:
    """Return the stages of failures of one name as a range: "place 2 to 5 of 18"."""
    numbered = [failure.stage for failure in failures if failure.stage.number is not None]
    if not numbered:
        return failures[0].stage.name
    numbers = _range([stage.number for stage in numbered])
    return f"{numbered[0].name} {numbers} of {_range([stage.total for stage in numbered])}"


def _steps(failures: Sequence[Failure]) -> str:
    known = [failure.to_go for failure in failures if failure.to_go is not None]
    return _range(known) if known else "not reached"


def _range(numbers: Sequence[int]) -> str:
    low, high = min(numbers), max(numbers)
    return f"{low}" if low == high else f"{low} to {high}"


def _medians(offsets: Sequence[Offset]) -> str:
    distance = np.median([offset.distance_mm for offset in offsets])
    turn = np.median([offset.rotation_deg for offset in offsets])
    others = sum(offset.is_other_primitive for offset in offsets)
    text = f"{distance:.1f} mm, {turn:.1f}°"
    return f"{text}, other primitive {others}/{len(offsets)}" if others else text


def _spreads(offsets: Sequence[Offset]) -> list[str]:
    """Return median and 90th percentile of distances and of rotations."""
    values = np.array([(offset.distance_mm, offset.rotation_deg) for offset in offsets])
    quantiles = np.quantile(values, (0.5, 0.9), axis=0).T
    return ["{:.1f}, 90 %: {:.1f}".format(*pair) for pair in quantiles]


def _share(flags: Iterable[bool]) -> str:
    return f"{np.mean([*flags]):.3f}"


def _caption(failure: Failure) -> str:
    to_go = "the expert does not reach the goal from here"
    if failure.to_go is not None:
        to_go = f"the expert's steps to the goal: {failure.to_go}"
    unmet = f"; not {', '.join(failure.unmet)}" if failure.unmet else ""
    where = f"seed {failure.seed}, step {failure.step} of {failure.steps}"
    return f"{failure.stage}, {where}: {to_go}; policy off by {_medians([failure.policy])}{unmet}"


def _failure_row(failure: Failure) -> dict[str, Any]:
    """Return a failure as a row of the CSV file."""
    return {
        "kind": failure.kind,
        "seed": failure.seed,
        "steps": failure.steps,
        "step": failure.step,
        "stage": failure.stage.name,
        "number": failure.stage.number,
        "of": failure.stage.total,
        "expert_steps_to_go": failure.to_go,
        "unmet": " ".join(failure.unmet),
        **_columns("policy", failure.policy),
        **_columns("rounded", failure.rounded),
        "label_jumps": failure.jumps,
        **{f"{name} succeeds": value for name, value in failure.successes.items()},
    }


def _state_row(row: StateRow) -> dict[str, Any]:
    """Return a state as a row of the CSV file."""
    return {
        "seed": row.seed,
        "step": row.step,
        "stage": row.stage,
        **_columns("policy", row.policy),
        **_columns("rounded", row.rounded),
        "label_jumps": row.jumps,
    }


def _columns(prefix: str, offset: Offset | None) -> dict[str, Any]:
    return {} if offset is None else {f"{prefix}_{k}": v for k, v in offset._asdict().items()}
