"""Reports of runs: curves (PNG), tables (CSV, Markdown) and a page (HTML).

A report is made from the ``result.json`` of finished runs (see `ba_torchrl.record.results`).
"""

from __future__ import annotations

import base64
import csv
import math
import os
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment

from ba_torchrl.record.plots import plot_panels
from ba_torchrl.record.results import now, why_unfinished
from ba_torchrl.record.summary import (
    COLUMNS,
    CONFIDENCE,
    GOOD_RATE,
    Section,
    load_sections,
    standard_error,
    summarize,
)

_NUMBERS = {
    "mean of the curve": ("curve_mean", ".3f"),
    f"updates to {GOOD_RATE:.0%}": ("updates_to_80", ".0f"),
    f"steps to {GOOD_RATE:.0%}": ("env_steps_to_80", ".0f"),
    "episode length": ("mean_length", ".1f"),
    "hours per run": ("hours", ".2f"),
}
"""Column of the table and format of each number, by its heading."""
_HEADER = (
    "task",
    "method",
    "seeds",
    "success ± standard error",
    f"{CONFIDENCE:.0%} interval",
    *_NUMBERS,
)


def write_report(roots: Sequence[str | Path], folder: str | Path) -> Path:
    """Write the report of all runs below some folders, and return the path of the page.

    The page contains the curves and tables, and links to the videos.

    Raises:
        FileNotFoundError: there is no finished run.
    """
    sections, unfinished = load_sections(roots)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tables = [summarize(section) for section in sections]
    pictures = [
        plot_section(section, folder / f"{_file_name(section.title)}.png") for section in sections
    ]
    with (folder / "table.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(row for table in tables for row in table)
    left_out = [
        {"path": _relative(path, folder), "reason": why_unfinished(path)} for path in unfinished
    ]
    texts = [_markdown(section, table) for section, table in zip(sections, tables, strict=True)]
    if left_out:
        lines = [f"- {run['path']}: {run['reason']}" for run in left_out]
        texts.append("\n".join(["## Not finished", "", *lines]))
    (folder / "table.md").write_text("\n\n".join(texts) + "\n", encoding="utf-8")
    template = files("ba_torchrl.record").joinpath("report.html").read_text(encoding="utf-8")
    page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(template)
    text = page.render(
        made=now(),
        sections=[
            {
                "title": section.title,
                "note": _note(section),
                "picture": base64.b64encode(picture.read_bytes()).decode(),
                "header": _HEADER,
                "rows": [_cells(row) for row in table],
                "videos": _videos(section, folder),
                "machines": _machines(section),
            }
            for section, table, picture in zip(sections, tables, pictures, strict=True)
        ],
        unfinished=left_out,
    )
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


# -- parts -----------------------------------------------------------------------------------


def plot_section(section: Section, path: Path) -> Path:
    """Plot the curves of every method, a panel for each task, and return the PNG."""
    panels: dict[str, dict[str, Any]] = {task: {} for task in section.tasks}
    for group in section.groups:
        mean, error = group.rates.mean(0), standard_error(group.rates)
        band = () if len(group.runs) == 1 else (mean - error, mean + error)
        panels[group.task][group.method] = (group.updates, mean, *band)
    return plot_panels(
        panels,
        path,
        names=section.methods,
        xlabel="updates",
        ylabel="success rate of the greedy policy",
    )


def _note(section: Section) -> str:
    """Return the definition of the reported numbers and their uncertainty."""
    counts = sorted({len(group.runs) for group in section.groups})
    seeds = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    policies = {run.result.final.policy for group in section.groups for run in group.runs}
    text = (
        f"Mean over {seeds} seed{'s' if counts[-1] > 1 else ''} of the greedy policy's success "
        f"rate, in the table that of each run's {' or '.join(sorted(policies))} policy on new "
        f"episodes; ± and shading: standard error over seeds; interval: bootstrap, "
        f"{CONFIDENCE:.0%}. To {GOOD_RATE:.0%}: when the mean curve first reaches that rate."
    )
    if counts[0] == 1:
        text += (
            " With a single seed there is neither shading nor interval: the spread over seeds is "
            "unknown."
        )
    return text


def _cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of a row as text."""
    error = "" if math.isnan(row["standard_error"]) else f" ± {row['standard_error']:.3f}"
    return [
        row["task"],
        row["method"],
        str(row["seeds"]),
        f"{row['success']:.3f}{error}",
        "–" if math.isnan(row["low"]) else f"{row['low']:.3f} to {row['high']:.3f}",
        *(
            "–" if math.isnan(row[column]) else format(row[column], form)
            for column, form in _NUMBERS.values()
        ),
    ]


def _markdown(section: Section, table: Sequence[dict[str, Any]]) -> str:
    lines = [f"## {section.title}", "", _note(section), "", f"| {' | '.join(_HEADER)} |"]
    lines.append("|" + "---|" * len(_HEADER))
    lines += [f"| {' | '.join(_cells(row))} |" for row in table]
    lines += ["", *(f"- {machine}" for machine in _machines(section))]
    return "\n".join(lines)


def _machines(section: Section) -> list[str]:
    """Return the different machines and package versions of the runs."""
    found = set()
    for group in section.groups:
        for run in group.runs:
            hardware, versions = run.result.hardware, run.result.versions
            where = f"{hardware.get('cpu')}, {hardware.get('cores')} cores"
            if hardware.get("gpu"):
                where += f", {hardware['gpu']}"
            packages = ", ".join(
                f"{name} {versions[name]}" for name in ("ba_torchrl", "torch") if name in versions
            )
            found.add(f"{where}, {hardware.get('threads')} threads; {packages}")
    return sorted(found)


def _videos(section: Section, folder: Path) -> list[dict[str, Any]]:
    """Return the videos of each group; the page shows the first seed's and links the others."""
    found = []
    for group in sorted(section.groups, key=lambda group: (group.task, group.method)):
        videos = [
            {"seed": run.result.seed, "source": _relative(run.folder / name, folder)}
            for run in group.runs
            for name in [run.result.files.get("video")]
            if name is not None and (run.folder / name).exists()
        ]
        if videos:
            caption = f"{group.task}, {group.method}"
            found.append({"caption": caption, "first": videos[0], "others": videos[1:]})
    return found


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()


def _file_name(title: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in title)
