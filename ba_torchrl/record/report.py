"""Reports of runs, made from the ``result.json`` of finished runs.

A folder with a page (HTML), curves (SVG, PDF), tables (CSV, Markdown, LaTeX), values and curves by
seed (CSV), and the videos.
"""

from __future__ import annotations

import csv
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment

from ba_torchrl.core.files import replaced, write_text
from ba_torchrl.record.plots import Learning, plot_panels
from ba_torchrl.record.results import CITABLE_EPISODES, now, why_unfinished
from ba_torchrl.record.statistics import CONFIDENCE
from ba_torchrl.record.summary import (
    DIRECTION,
    ENOUGH_SEEDS,
    GOOD_RATE,
    POOLED,
    Axis,
    Changes,
    Completed,
    Group,
    Run,
    Section,
    compare,
    differing_settings,
    load_sections,
    summarize,
)

_NUMBERS = {
    "best": ("best", ".3f"),
    "area": ("area", ".3f"),
    f"updates to {GOOD_RATE:.0%}": ("updates_to_80", ".0f"),
    f"steps to {GOOD_RATE:.0%}": ("env_steps_to_80", ".0f"),
    "episode length": ("mean_length", ".1f"),
    "hours per run": ("hours", ".2f"),
}
"""Column of the table and format of each number, by its heading."""
_INTERVAL = f"{CONFIDENCE:.0%} interval"
_HEADER = ("task", "method", "seeds", "episodes", "success", _INTERVAL, *_NUMBERS)
_COMPARISONS_HEADER = (
    "task",
    "first",
    "second",
    "seeds",
    "difference",
    _INTERVAL,
    "P(first is better)",
    _INTERVAL,
    "",
)
_AXES: dict[Axis, str] = {"env_steps": "environment steps", "updates": "updates"}
_FORMATS = (".svg", ".pdf")
_DEFINITIONS = (
    "Success: mean over seeds of the success rates of the last policies in their test episodes, of "
    "the greedy policy; for all tasks the mean over tasks. Best: of the checkpoints with the best "
    f"evaluation. Intervals and shading, {CONFIDENCE:.0%}: hierarchical bootstrap over seeds and "
    "test scenes, stratified by task, never narrower than Wilson's of one run; that of a single "
    "run does not contain the spread over seeds. Area: mean success of the evaluations during "
    "training over environment steps, to the last step of all methods on the task. To "
    f"{GOOD_RATE:.0%}: when the mean curve first reaches that rate. Differences are paired by seed "
    "and test scene; P is the probability that a run of the first method has the higher success."
)
_SETTINGS_HEADER = ("setting", "value", "methods")


def write_report(
    roots: Sequence[str | Path],
    folder: str | Path,
    *,
    axis: Axis = "env_steps",
    changes: Changes = lambda _: {},
    completed: Completed = lambda run: run,
) -> Path:
    """Write the report of all runs below some folders, and return the path of the page.

    Args:
        roots: the folders.
        folder: of the report; videos are copied into it.
        axis: of the curves.
        changes: tells which runs do not have the settings of their benchmark.
        completed: fills in the defaults of settings that are newer than a run.

    Raises:
        FileNotFoundError: there is no finished run.
    """
    sections, unfinished = load_sections(roots, changes, completed)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    left_out = [f"{_relative(path, folder)}: {why_unfinished(path)}" for path in unfinished]
    parts = [_part(section, folder, axis) for section in sections]
    _write_csv(folder / "table.csv", (row for part in parts for row in part["table"]))
    rows = [row for part in parts for row in part["comparisons"]]
    _write_csv(folder / "comparisons.csv", rows)
    runs = [named for section in sections for named in _by_seed(section)]
    _write_csv(folder / "seeds.csv", ({**names, **_final(run)} for run, names in runs))
    points = ({**names, **p.model_dump()} for run, names in runs for p in run.result.curve)
    _write_csv(folder / "curves.csv", points)
    texts = [_DEFINITIONS, *map(_markdown, parts)]
    if left_out:
        texts.append("\n".join(["## Not finished", "", *(f"- {run}" for run in left_out)]))
    write_text(folder / "table.md", "\n\n".join(texts) + "\n")
    tables = "\n\n".join(_latex(part) for part in parts)
    write_text(folder / "table.tex", tables + "\n")
    template = files("ba_torchrl.record").joinpath("report.html").read_text(encoding="utf-8")
    page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(template)
    texts = {"definitions": _DEFINITIONS, "unfinished": left_out, "made": now()}
    headers = {"header": _HEADER, "settings_header": _SETTINGS_HEADER}
    headers["comparisons_header"] = _COMPARISONS_HEADER
    return write_text(folder / "report.html", page.render(sections=parts, **texts, **headers))


def plot_groups(
    groups: Sequence[Group],
    paths: Sequence[Path],
    axis: Axis = "env_steps",
    methods: Sequence[str] | None = None,
) -> None:
    """Plot the curves of every method with their intervals and seeds, a panel for each task.

    Over environment steps, dotted lines from the left to 0 are steps of demonstrations.

    Args:
        groups: see `ba_torchrl.record.summary.grouped`.
        paths: of the figure in several formats.
        axis: of the curves.
        methods: in the order of colours; those of the groups if None.
    """
    panels: dict[str, dict[str, Learning]] = {group.task: {} for group in groups}
    for group in groups:
        x, curve = group.axis(axis), group.curve
        if len(set(x)) == 1:  # as without steps but demonstrations
            x, curve = x[-1:], [values[-1:] for values in curve]
        runs = [
            ([getattr(point, axis) for point in points], [point.success_rate for point in points])
            for points in (run.result.curve for run in group.runs)
        ]
        demonstrations = [run.result.demonstration_steps or 0 for run in group.runs]
        panels[group.task][group.method] = Learning(
            (x, *curve),
            runs if runs[1:] and x.size > 1 else (),
            float(np.mean(demonstrations)) if axis == "env_steps" else 0.0,
        )
    plot_panels(
        panels,
        paths,
        names=methods or sorted({group.method for group in groups}),
        xlabel=_AXES[axis],
        ylabel="success rate",
    )


# -- parts -----------------------------------------------------------------------------------


def _part(section: Section, folder: Path, axis: Axis) -> dict[str, Any]:
    """Draw the figures of a section; return what the texts have of it."""
    name, table, comparisons = _file_name(section.title), summarize(section), compare(section)
    plot_groups(section.groups, [folder / f"{name}{end}" for end in _FORMATS], axis)
    panels = {task: f"{name}/{_file_name(task)}" for task in section.tasks}
    for task, stem in panels.items():
        of_task = [group for group in section.groups if group.task == task]
        plot_groups(of_task, [folder / f"{stem}{end}" for end in _FORMATS], axis, section.methods)
    return {
        "title": section.title,
        "name": name,
        "note": _note(section),
        "warnings": _warnings(section),
        "panels": panels,
        "table": table,
        "rows": [_cells(row) for row in table],
        "comparisons": comparisons,
        "compared": [_compared(row) for row in comparisons],
        "settings": differing_settings(section),
        "videos": _videos(section, folder),
        "machines": _machines(section),
    }


def _note(section: Section) -> str:
    """Return which policies the numbers are of, and where the curves start."""
    text = "The table has the last policy of each run, on episodes that did not select it."
    starts = (int(update) for group in section.groups for update in group.axis("updates")[:1])
    first = sorted({*starts} - {0})
    if first:
        after = " to ".join(str(updates) for updates in dict.fromkeys((first[0], first[-1])))
        text += f" Curves start at the first evaluation, after {after} updates."
    return text


def _warnings(section: Section) -> list[str]:
    """Return what is not the benchmark's, and what the number of seeds leaves unknown."""
    found = [
        f"{name} is {there} instead of {planned}"
        for name, pairs in sorted(section.changes.items())
        for there, planned in sorted(pairs)
    ]
    texts = [f"Not the values of the benchmark: {'; '.join(found)}."] if found else []
    least = min(len(group.runs) for group in section.groups)
    if least < ENOUGH_SEEDS:
        texts.append(
            f"Fewer than {ENOUGH_SEEDS} seeds: {DIRECTION}; these numbers do not rank methods."
        )
    few = [f"{row.task}, {row.method}" for row in section.groups if not _is_citable(row)]
    if few:
        texts.append(
            f"Tests with fewer than {CITABLE_EPISODES} episodes, not to be cited: {'; '.join(few)}."
        )
    if section.not_pooled:
        texts.append(
            f"Not pooled, as they differ in {' or '.join(POOLED)}: {'; '.join(section.not_pooled)}."
        )
    return texts


def _is_citable(group: Group) -> bool:
    return all(test.is_citable for test in group.tests)


def _cells(row: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return the cells of a row: text, and the value by which rows are sorted."""
    numbers = [(row[column], form) for column, form in _NUMBERS.values()]
    return [
        *((str(row[name]), row[name]) for name in ("task", "method", "seeds", "episodes")),
        (_text(row["success"]), row["success"]),
        (_range(row["low"], row["high"]), row["low"]),
        *((_text(value, form), value) for value, form in numbers),
    ]


def _compared(row: dict[str, Any]) -> list[str]:
    """Return the cells of a comparison."""
    return [
        *(str(row[name]) for name in ("task", "first", "second", "seeds")),
        _text(row["difference"], "+.3f"),
        _range(row["low"], row["high"], "+.3f"),
        _text(row["improvement"], ".2f"),
        _range(row["improvement_low"], row["improvement_high"], ".2f"),
        row["reading"],
    ]


def _text(value: float, form: str = ".3f") -> str:
    return "–" if math.isnan(value) else format(value, form)


def _range(low: float, high: float, form: str = ".3f") -> str:
    return "–" if math.isnan(low) else f"{low:{form}} to {high:{form}}"


def _write_csv(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    rows = list(rows)
    with replaced(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _by_seed(section: Section) -> Iterator[tuple[Run, dict[str, Any]]]:
    """Yield each run with the columns that name it."""
    for group in section.groups:
        for run in group.runs:
            names = (section.title, group.task, group.method, run.result.seed)
            yield run, dict(zip(("benchmark", "task", "method", "seed"), names, strict=True))


def _final(run: Run) -> dict[str, Any]:
    """Return the columns of a run's final evaluation, and where it ran."""
    result = run.result
    where = {name: result.hardware.get(name) for name in ("cpu", "gpu")}
    where |= {"commit": result.versions.get("commit"), "folder": run.folder}
    last = result.last
    test = {name: getattr(last, name) for name in ("updates", "episodes", "success_rate")}
    test["mean_length"] = last.mean_length
    test["best_success_rate"] = result.best.success_rate
    test |= {name: of(result) for name, of in POOLED.items()}
    hours = None if result.seconds is None else result.seconds / 3600
    return {**test, "hours": hours, **where}


def _markdown(part: dict[str, Any]) -> str:
    lines = [f"## {part['title']}", "", part["note"]]
    lines += [line for text in part["warnings"] for line in ("", f"**{text}**")]
    lines += ["", *pipes(_HEADER, ([text for text, _ in row] for row in part["rows"]))]
    if part["compared"]:
        lines += ["", "Comparisons:", "", *pipes(_COMPARISONS_HEADER, part["compared"])]
    if part["settings"]:
        lines += ["", "Settings in which methods differ:", ""]
        lines += pipes(_SETTINGS_HEADER, part["settings"])
    return "\n".join([*lines, "", *(f"- {machine}" for machine in part["machines"])])


def pipes(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    return [f"| {' | '.join(row)} |" for row in (header, ["---"] * len(header), *rows)]


def _latex(part: dict[str, Any]) -> str:
    """Return the table in LaTeX, for the package booktabs."""
    head, *rows = (
        " & ".join(map(_escape, row)) + r" \\"
        for row in (_HEADER, *([text for text, _ in row] for row in part["rows"]))
    )
    body = [r"\toprule", head, r"\midrule", *rows, r"\bottomrule"]
    begin = rf"\begin{{tabular}}{{ll{'r' * (len(_HEADER) - 2)}}}"
    notes = [f"% {text}" for text in (part["title"], _DEFINITIONS, part["note"], *part["warnings"])]
    return "\n".join([*notes, begin, *body, r"\end{tabular}"])


def _escape(text: str) -> str:
    text = text.replace("\\", r"\textbackslash ").replace("–", "--")
    return "".join(f"\\{c}" if c in "&%$#_{}" else c for c in text)


def _machines(section: Section) -> list[str]:
    """Return the different machines, package versions and commits of the runs."""
    found = set()
    for run, _ in _by_seed(section):
        hardware, versions = run.result.hardware, run.result.versions
        where = f"{hardware.get('cpu')}, {hardware.get('cores')} cores"
        where += f", {hardware['gpu']}" if hardware.get("gpu") else ""
        names = [name for name in ("ba_torchrl", "commit", "torch") if name in versions]
        packages = ", ".join(f"{name} {versions[name]}" for name in names)
        found.add(f"{where}, {hardware.get('threads')} threads; {packages}")
    return sorted(found)


def _videos(section: Section, folder: Path) -> list[dict[str, Any]]:
    """Copy the videos; the page shows the first seed's of each group and links the others."""
    found = []
    for group in section.groups:
        videos = []
        for run in group.runs:
            source = run.folder / run.result.files.get("video", "")
            if source.is_file():
                name = _file_name(f"{group.task} {group.method} seed{run.result.seed}")
                target = folder / "videos" / _file_name(section.title) / (name + source.suffix)
                with replaced(target) as scratch:
                    shutil.copyfile(source, scratch)
                videos.append({"seed": run.result.seed, "source": _relative(target, folder)})
        if videos:
            caption = f"{group.task}, {group.method}"
            found.append({"caption": caption, "first": videos[0], "others": videos[1:]})
    return found


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()


def _file_name(title: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in title)
