"""Reports of runs, made from the ``result.json`` of finished runs.

A folder with a page (HTML), curves (SVG, PDF), tables (CSV, Markdown), values and curves by seed
(CSV), and the videos.
"""

from __future__ import annotations

import csv
import itertools
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader

from ba_torchrl.core.files import atomic_file, write_text
from ba_torchrl.record.plots import Learning, plot_panels
from ba_torchrl.record.results import CITABLE_EPISODES, file_of, now, why_unfinished
from ba_torchrl.record.statistics import CONFIDENCE
from ba_torchrl.record.summary import (
    AXES,
    DIRECTION,
    ENOUGH_SEEDS,
    GOOD_RATE,
    LATE,
    POOLED,
    Axis,
    Group,
    Run,
    Section,
    axis_of,
    compare,
    differing_settings,
    markdown,
    pipes,
    summarize,
)
from ba_torchrl.record.video import VIDEO_SUFFIXES


class _Column(NamedTuple):
    """A column of a table whose rows are numbers and texts by name."""

    heading: str
    key: str
    """What rows are sorted by; a cell in whose row it is nan is a dash."""
    form: str

    def cell(self, row: dict[str, Any]) -> str:
        return (
            "–" if row[self.key] != row[self.key] else self.form.format(**row).replace("+nan", "–")
        )


class _Table(NamedTuple):
    """A table of a section."""

    title: str
    columns: Sequence[_Column]
    rows: Sequence[dict[str, Any]]


def _texts(*names: str) -> list[_Column]:
    return [_Column(name, name, f"{{{name}}}") for name in names]


_INTERVAL = f"{CONFIDENCE:.0%} interval"
_TABLE = (
    *_texts("task", "method", "seeds", "episodes"),
    _Column("success", "success", "{success:.3f}"),
    _Column(_INTERVAL, "low", "{low:.3f} to {high:.3f}"),
    _Column("best", "best", "{best:.3f}"),
    _Column("area", "area", "{area:.3f}"),
    _Column("late", "late", "{late:.3f}"),
    _Column(f"updates to {GOOD_RATE:.0%}", "updates_to_80", "{updates_to_80:.0f}"),
    _Column(f"steps to {GOOD_RATE:.0%}", "env_steps_to_80", "{env_steps_to_80:.0f}"),
    _Column("episode length", "mean_length", "{mean_length:.1f}"),
    _Column("hours per run", "hours", "{hours:.2f}"),
)
_COMPARISONS = (
    *_texts("task", "first", "second", "seeds"),
    _Column("difference", "difference", "{difference:+.3f}"),
    _Column(_INTERVAL, "low", "{low:+.3f} to {high:+.3f}"),
    _Column("area", "area", "{area:+.3f} ({area_low:+.3f} to {area_high:+.3f})"),
    _Column("late", "late", "{late:+.3f} ({late_low:+.3f} to {late_high:+.3f})"),
    _Column("", "reading", "{reading}"),
)
_SETTINGS = _texts("setting", "value", "methods")
_FORMATS = (".svg", ".pdf")
_NAME_BYTES = 180
"""Longest name of a file before a seed and a suffix; file systems allow 255 bytes."""
_DEFINITIONS = (
    "Success: mean over seeds of the success rates of the last policies in their test episodes, of "
    "the greedy policy; for all tasks the mean over tasks. Best: of the checkpoints with the best "
    f"evaluation. Intervals and shading, {CONFIDENCE:.0%}: Student's t over seeds and the normal "
    "distribution over test scenes, never narrower than Wilson's of one run; that of a single run "
    "does not contain the spread over seeds. Area: mean success of the evaluations during training "
    "over environment steps, to the last step of all methods on the task, or over updates if no "
    "method takes a step. Late: mean of the last "
    f"{LATE} of these evaluations. To "
    f"{GOOD_RATE:.0%}: when the mean curve first reaches that rate. Differences are paired by seed "
    "and test scene, those of area and late success by seed alone."
)


def write_report(
    sections: Sequence[Section],
    unfinished: Iterable[Path],
    folder: str | Path,
    axis: Axis = "env_steps",
) -> Path:
    """Write the report of runs, and return the path of the page.

    Args:
        sections: the finished runs; see `ba_torchrl.record.summary.sections`.
        unfinished: folders of other runs, which are listed.
        folder: of the report; videos are copied into it.
        axis: of the curves.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    left_out = [
        f"{Path(os.path.relpath(path, folder)).as_posix()}: {why_unfinished(path)}"
        for path in unfinished
    ]
    stems = _file_names(section.title for section in sections)
    parts = [
        _part(section, stem, folder, axis) for section, stem in zip(sections, stems, strict=True)
    ]
    runs = [
        ({"benchmark": section.title, "task": group.task, "method": group.method}, run)
        for section in sections
        for group in section.groups
        for run in group.runs
    ]
    for name, rows in {
        "table": [row for part in parts for row in part["tables"][0].rows],
        "comparisons": [row for part in parts for row in part["tables"][1].rows],
        "seeds": [{**names, **_final(run)} for names, run in runs],
        "curves": [
            {**names, "seed": run.result.seed, **point.model_dump()}
            for names, run in runs
            for point in run.result.curve
        ],
    }.items():
        write_csv(folder / f"{name}.csv", rows)
    texts = [_DEFINITIONS, *map(_markdown, parts)]
    if left_out:
        listed = (f"- {markdown(run)}" for run in left_out)
        texts.append("\n".join(["## Not finished", "", *listed]))
    write_text(folder / "table.md", "\n\n".join(texts) + "\n")
    return write_page(
        folder / "report.html",
        sections=parts,
        definitions=_DEFINITIONS,
        unfinished=left_out,
        made=now(),
    )


def write_page(path: Path, **values: Any) -> Path:
    """Write a page from the template of its name, and return its path.

    Args:
        path: of the page.
        values: what the template shows; it is escaped.
    """
    folder = PackageLoader("ba_torchrl.record", ".")
    pages = Environment(loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return write_text(path, pages.get_template(path.name).render(**values))


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows with the same keys as a CSV file, which is safe to open in a spreadsheet."""
    with atomic_file(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _cell(value) for key, value in row.items()} for row in rows)


def plot_groups(
    groups: Sequence[Group],
    paths: Sequence[Path],
    axis: Axis = "env_steps",
    methods: Sequence[str] | None = None,
    columns: int = 4,
) -> None:
    """Plot the curves of every method with its seeds, a panel for each task.

    One seed and five or more have a band, the interval.

    Over environment steps, dotted lines from the left to 0 are steps of demonstrations.

    Args:
        groups: see `ba_torchrl.record.summary.grouped`.
        paths: of the figure in several formats.
        axis: of the curves; updates if no run takes environment steps.
        methods: in the order of colours; those of the groups if None.
        columns: most panels in a row.
    """
    if axis == "env_steps":
        axis = axis_of(groups)
    panels: dict[str, dict[str, Learning]] = {group.task: {} for group in groups}
    for group in groups:
        x, curve = group.axis(axis), group.curve
        if len(set(x)) == 1:  # as without steps but demonstrations
            x, curve = x[-1:], [values[-1:] for values in curve]
        runs = [
            ([getattr(point, axis) for point in points], [point.success_rate for point in points])
            for points in (run.result.curve for run in group.runs)
        ]
        if 1 < len(runs) < ENOUGH_SEEDS:  # which are all drawn
            curve = curve[:1]
        demonstrations = [run.result.demonstration_steps or 0 for run in group.runs]
        panels[group.task][group.method] = Learning(
            (x, *curve),
            runs if runs[1:] and x.size > 1 else (),
            float(np.mean(demonstrations)) if axis == "env_steps" else 0.0,
        )
    names = methods or sorted({group.method for group in groups})
    plot_panels(panels, paths, names=names, xlabel=AXES[axis], columns=columns)


def _part(section: Section, name: str, folder: Path, axis: Axis) -> dict[str, Any]:
    """Draw the figures of a section, whose files have a name; return what the texts have of it."""
    plot_groups(section.groups, [folder / f"{name}{end}" for end in _FORMATS], axis)
    names = zip(section.tasks, _file_names(section.tasks), strict=True)
    panels = {task: f"{name}/{stem}" for task, stem in names}
    for task, stem in panels.items():
        paths = [folder / f"{stem}{end}" for end in _FORMATS]
        plot_groups(section.of_task(task), paths, axis, section.methods)
    return {
        "title": section.title,
        "name": name,
        "warnings": list(_warnings(section)),
        "panels": panels,
        "tables": [
            _Table("Success", _TABLE, summarize(section)),
            _Table("Comparisons", _COMPARISONS, compare(section)),
            _Table("Settings in which methods differ", _SETTINGS, differing_settings(section)),
        ],
        "videos": _videos(section, name, folder),
        "machines": sorted({_machine(run) for group in section.groups for run in group.runs}),
    }


def _warnings(section: Section) -> Iterator[str]:
    """Yield what is not the benchmark's, and what the number of seeds leaves unknown."""
    if section.changes:
        yield f"Not the values of the benchmark: {'; '.join(section.changes)}."
    if min(len(group.runs) for group in section.groups) < ENOUGH_SEEDS:
        yield f"Fewer than {ENOUGH_SEEDS} seeds: {DIRECTION}; these numbers do not rank methods."
    rows = (g for g in section.groups if not all(test.is_citable for test in g.tests))
    if few := [f"{group.task}, {group.method}" for group in rows]:
        least = f"fewer than {CITABLE_EPISODES} episodes"
        yield f"Tests with {least}, not to be cited: {'; '.join(few)}."


def _final(run: Run) -> dict[str, Any]:
    """Return the columns of a run's seed, its tests, and where it ran."""
    result, last = run.result, run.result.last
    return {
        "seed": result.seed,
        **{name: getattr(last, name) for name in ("updates", "episodes", "success_rate")},
        "mean_length": last.mean_length,
        "best_success_rate": result.best.success_rate,
        **{name: of(result) for name, of in POOLED.items()},
        "hours": None if result.seconds is None else run.hours,
        **{name: result.hardware.get(name) for name in ("cpu", "gpu")},
        "commit": result.versions.get("commit"),
        "folder": run.folder,
    }


def _cell(value: object) -> object:
    """Return a cell of a CSV file: a number, or a text that no spreadsheet takes for a formula."""
    if value is None or isinstance(value, int | float):
        return value
    is_formula = str(value).lstrip().startswith(("=", "+", "-", "@"))
    return f"'{value}" if is_formula else str(value)


def _markdown(part: dict[str, Any]) -> str:
    warnings = (f"**{markdown(text)}**" for text in part["warnings"])
    paragraphs = [f"## {markdown(part['title'])}", *warnings]
    for table in part["tables"]:
        if table.rows:
            cells = ([column.cell(row) for column in table.columns] for row in table.rows)
            headings = [column.heading for column in table.columns]
            paragraphs += [f"{table.title}:", "\n".join(pipes(headings, *cells))]
    machines = (f"- {markdown(machine)}" for machine in part["machines"])
    return "\n\n".join([*paragraphs, "\n".join(machines)])


def _machine(run: Run) -> str:
    """Return the machine, the package versions and the commit of a run."""
    hardware, versions = run.result.hardware, run.result.versions
    where = f"{hardware.get('cpu')}, {hardware.get('cores')} cores"
    where += f", {hardware['gpu']}" if hardware.get("gpu") else ""
    names = [name for name in ("ba_torchrl", "commit", "torch") if name in versions]
    packages = ", ".join(f"{name} {versions[name]}" for name in names)
    return f"{where}, {hardware.get('threads')} threads; {packages}"


def _videos(section: Section, stem: str, folder: Path) -> list[dict[str, Any]]:
    """Copy the videos; return their files by seed for each group that has some."""
    groups = [(group.task, group.method) for group in section.groups]
    names = dict(zip(groups, _file_names(map(" ".join, groups)), strict=True))
    found = []
    for group in section.groups:
        files = {}
        for run in group.runs:
            source = file_of(run.folder, run.result, "video")
            if source is not None and source.suffix.lower() in VIDEO_SUFFIXES:
                name = f"{names[group.task, group.method]}_seed{run.result.seed}{source.suffix}"
                with atomic_file(folder / "videos" / stem / name) as scratch:
                    shutil.copyfile(source, scratch)
                files[run.result.seed] = f"videos/{stem}/{name}"
        if files:
            found.append({"caption": f"{group.task}, {group.method}", "files": files})
    return found


def _file_names(titles: Iterable[str]) -> list[str]:
    """Return a name of files for each title; no two are the same, also if case is ignored."""
    names: dict[str, str] = {}
    for title in titles:
        text = re.sub(r"[^\w-]", "_", title) or "_"
        stem = name = os.fsencode(text)[:_NAME_BYTES].decode(errors="ignore")
        for number in itertools.count(2):
            if name.casefold() not in names:
                break
            name = f"{stem}-{number}"
        names[name.casefold()] = name
    return list(names.values())
