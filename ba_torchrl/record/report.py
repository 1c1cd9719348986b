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

from jinja2 import Environment

from ba_torchrl.data.files import replaced, write_text
from ba_torchrl.record.plots import plot_panels
from ba_torchrl.record.results import now, why_unfinished
from ba_torchrl.record.summary import (
    CONFIDENCE,
    ENOUGH_SEEDS,
    GOOD_RATE,
    Axis,
    Changes,
    Completed,
    Run,
    Section,
    differing_settings,
    load_sections,
    summarize,
)

_NUMBERS = {
    "mean": ("success_mean", ".3f"),
    "mean of the curve": ("curve_mean", ".3f"),
    f"updates to {GOOD_RATE:.0%}": ("updates_to_80", ".0f"),
    f"steps to {GOOD_RATE:.0%}": ("env_steps_to_80", ".0f"),
    "episode length": ("mean_length", ".1f"),
    "hours per run": ("hours", ".2f"),
}
"""Column of the table and format of each number, by its heading."""
_HEADER = ("task", "method", "seeds", "success (IQM)", f"{CONFIDENCE:.0%} interval", *_NUMBERS)
_AXES: dict[Axis, str] = {"updates": "updates", "env_steps": "environment steps"}
_FORMATS = (".svg", ".pdf")
_DEFINITIONS = (
    "Success rate of the greedy policy: interquartile mean (IQM) over seeds, for all tasks over "
    f"seeds and tasks. Intervals and shading, {CONFIDENCE:.0%}: bootstrap over seeds, stratified "
    "by task; for a single run, and where all runs have the same rate, Wilson's over their "
    f"episodes. To {GOOD_RATE:.0%}: when the curve first reaches that rate."
)
_SETTINGS_HEADER = ("setting", "value", "methods")


def write_report(
    roots: Sequence[str | Path],
    folder: str | Path,
    *,
    axis: Axis = "updates",
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
    return write_text(folder / "report.html", page.render(sections=parts, **texts, **headers))


def plot_section(
    section: Section, paths: Sequence[Path], axis: Axis = "updates", task: str | None = None
) -> None:
    """Plot the curves of every method with their intervals, a panel for each task or for one."""
    panels: dict[str, dict[str, Any]] = {each: {} for each in section.tasks}
    for group in section.groups:
        found, x = group.estimate, group.axis(axis)
        curve = [values[:-1] for values in (found.value, found.low, found.high)]
        panels[group.task][group.method] = (x, *curve)
    plot_panels(
        panels if task is None else {task: panels[task]},
        paths,
        names=section.methods,
        xlabel=_AXES[axis],
        ylabel="success rate",
    )


# -- parts -----------------------------------------------------------------------------------


def _part(section: Section, folder: Path, axis: Axis) -> dict[str, Any]:
    """Draw the figures of a section; return what the texts have of it."""
    name, table = _file_name(section.title), summarize(section)
    plot_section(section, [folder / f"{name}{end}" for end in _FORMATS], axis)
    panels = {task: f"{name}/{_file_name(task)}" for task in section.tasks}
    for task, stem in panels.items():
        plot_section(section, [folder / f"{stem}{end}" for end in _FORMATS], axis, task)
    return {
        "title": section.title,
        "name": name,
        "note": _note(section),
        "warnings": _warnings(section),
        "panels": panels,
        "table": table,
        "rows": [_cells(row) for row in table],
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
        text = f"Fewer than {ENOUGH_SEEDS} seeds: methods cannot be ranked by these numbers."
        single = " The interval of a single run does not contain the spread over seeds."
        texts.append(text + (single if least == 1 else ""))
    return texts


def _cells(row: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return the cells of a row: text, and the value by which rows are sorted."""
    interval = "–" if math.isnan(row["low"]) else f"{row['low']:.3f} to {row['high']:.3f}"
    numbers = [(row[column], form) for column, form in _NUMBERS.values()]
    return [
        *((str(row[name]), row[name]) for name in ("task", "method", "seeds")),
        (f"{row['success_iqm']:.3f}", row["success_iqm"]),
        (interval, row["low"]),
        *(("–" if math.isnan(value) else format(value, form), value) for value, form in numbers),
    ]


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
    return {**test, "hours": result.seconds / 3600, **where}


def _markdown(part: dict[str, Any]) -> str:
    lines = [f"## {part['title']}", "", part["note"]]
    lines += [line for text in part["warnings"] for line in ("", f"**{text}**")]
    lines += ["", *_pipes(_HEADER, ([text for text, _ in row] for row in part["rows"]))]
    if part["settings"]:
        lines += ["", "Settings in which methods differ:", ""]
        lines += _pipes(_SETTINGS_HEADER, part["settings"])
    return "\n".join([*lines, "", *(f"- {machine}" for machine in part["machines"])])


def _pipes(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
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
