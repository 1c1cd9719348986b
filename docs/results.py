"""Write results.md and its figures from results.

python -m docs.results                        # the page
python -m docs.results runs/equivariance      # add the results of these runs first

Those of a benchmark that answers a question are in docs/results/BENCHMARK, those of the shipped
policies in their files (`docs.shipped`).
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ba_torchrl.commands.report import completed
from ba_torchrl.core.files import write_text
from ba_torchrl.envs.description import describe, tasks_by_heading
from ba_torchrl.record.leaderboard import (
    LEGEND,
    Leaderboard,
    leaderboard,
    read_results,
    success_text,
)
from ba_torchrl.record.plots import Learning, own_style, plot_panels, save
from ba_torchrl.record.report import plot_groups
from ba_torchrl.record.summary import (
    AXES,
    GOOD_RATE,
    Axis,
    Group,
    Run,
    Section,
    axis_of,
    compare,
    grouped,
    load_runs,
    pipes,
)
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.protocol import PROTOCOL
from docs.sources import ROOT

PAGE = ROOT / "docs" / "results.md"
FOLDER = ROOT / "docs" / "results"
MEASURES = (
    ("area", "area_low", "area_high"),
    ("late", "late_low", "late_high"),
    ("difference", "low", "high"),
)
"""Columns of the differences, and of their intervals, in a comparison."""
OVER_DEMONSTRATIONS = "_demonstrations.svg"
ALL_TASKS = "results"
"""Marker of the tables of all tasks in the page; those of questions are their benchmarks' names."""
MARKED = re.compile(r"(<!-- (\w+): begin -->\n).*?(<!-- \2: end -->\n)", re.DOTALL)
HEADER = ("task", "expert", "method", "success", "steps", "environment steps", "minutes")
COMPARED = (
    "task",
    "method",
    "area",
    "late success",
    "last policy",
    f"environment steps to {GOOD_RATE}",
    "minutes",
)
DIFFERENCES = ("task", "first", "second", "seeds", "area", "late success", "last policy", "")


def add(roots: Sequence[str]) -> int:
    """Write the results of the finished runs below some folders to their places.

    Returns:
        Their number.

    Raises:
        ValueError: runs have the same benchmark, task, label and seed, and with them the same file,
            or a benchmark that answers no question.
    """
    named: dict[Path, Run] = {}
    for run in load_runs(roots)[0]:
        result = run.result
        name = f"{result.task} {result.label} seed{result.seed}"
        name = "".join(c if c.isalnum() or c in "-." else "_" for c in name) + ".json"
        path = FOLDER / str(result.benchmark) / name
        if not path.parent.is_dir():
            raise ValueError(f"{run.folder} is no run of a question: there is no {path.parent}")
        if path in named:
            raise ValueError(f"{named[path].folder} and {run.folder} are both {name}")
        named[path] = run
    for path, run in named.items():
        write_text(path, run.result.model_dump_json() + "\n")
    return len(named)


def present() -> Leaderboard:
    """Return the shipped policies' results by task and method, tasks of plugins left out."""
    tasks = [task for task in TASKS if TASKS.plugin_module(task) is None]
    return leaderboard(completed(read_results()), [], tasks, PROTOCOL)


def questions() -> dict[str, Section]:
    """Return the results of each benchmark that answers a question, by its name."""
    return {
        folder.name: Section(folder.name, grouped(completed(read_results(folder))))
        for folder in sorted(FOLDER.iterdir())
        if folder.is_dir()
    }


def page_with_results(text: str) -> str:
    """Return the page with tables of the present results between its markers.

    Raises:
        KeyError: there are no results of a marker's name.
    """
    texts = {name: "\n".join(_question(section)) for name, section in questions().items()}
    texts[ALL_TASKS] = "\n".join(_all_tasks(present()))
    return MARKED.sub(lambda found: f"{found[1]}\n{texts[found[2]]}\n{found[3]}", text)


def _question(section: Section) -> Iterator[str]:
    """Yield the lines of the answer to a question.

    Differences are those to each task's best method by late success, and all with an interval that
    excludes zero.
    """
    axis = AXES[axis_of(section.groups)]
    yield f"![Success over {axis}](results/{section.title}.svg)\n"
    if (FOLDER / (figure := f"{section.title}{OVER_DEMONSTRATIONS}")).exists():
        yield f"![Success over demonstrations](results/{figure})\n"
    rows = (_compared_cells(group, *section.span(group.task)) for group in section.groups)
    yield from pipes(COMPARED, *rows)
    yield ""
    late = {id(group): sum(group.late().values()) / len(group.late()) for group in section.groups}
    best = {group.task: group for group in sorted(section.groups, key=lambda each: late[id(each)])}
    rows = (
        row
        for row in compare(section)
        if row["task"] in best
        and (_has(row, best[row["task"]].method) or any(_excludes_zero(row, *m) for m in MEASURES))
    )
    yield from pipes(DIFFERENCES, *map(_difference, rows))
    yield ""
    yield _origin([run for group in section.groups for run in group.runs])


def _excludes_zero(row: Mapping[str, Any], _: str, low: str, high: str) -> bool:
    return row[low] > 0 or row[high] < 0


def _has(row: Mapping[str, Any], method: str) -> bool:
    return method in (row["first"], row["second"])


def _compared_cells(group: Group, axis: Axis, end: int) -> list[str]:
    steps = group.reaches(GOOD_RATE)[1]
    return [
        f"`{group.task}`",
        group.method,
        _mean(list(group.areas(axis, end).values()), ".2f"),
        _mean(list(group.late().values()), ".2f"),
        _unbroken(success_text(group)),
        "–" if math.isnan(steps) else f"{steps:.0f}",
        _mean([run.result.seconds and run.result.seconds / 60 for run in group.runs]),
    ]


def _difference(row: Mapping[str, Any]) -> list[str]:
    names = (f"`{row['task']}`", row["first"], row["second"], row["seeds"])
    cells = (
        _unbroken(f"{row[value]:+.2f} ({row[low]:+.2f} to {row[high]:+.2f})").replace("+nan", "–")
        if row[value] == row[value]
        else "–"
        for value, low, high in MEASURES
    )
    return [*map(str, names), *cells, str(row["reading"])]


def _all_tasks(board: Leaderboard) -> Iterator[str]:
    """Yield the lines of the tables of all tasks."""
    yield "![Success of all tasks](results/tasks.svg)\n"
    yield f"{LEGEND}\n"
    if board.left_out:
        runs = [f"- {run}".replace(f"{ROOT}/", "") for run in board.left_out]
        yield from ("Left out:", "", *runs, "")
    for heading, tasks in tasks_by_heading(board.tasks).items():
        yield f"### {heading}\n"
        yield from pipes(HEADER, *(row for task in tasks for row in _rows(board, task)))
        yield ""
    runs = [run for group in board.groups for run in group.runs]
    if runs:
        yield from _trained(runs)
        yield f"Tests of policies: {_origin(runs)}"


def _trained(runs: Sequence[Run]) -> Iterator[str]:
    """Yield where policies in files were trained, and what is not known of their training."""
    results = [run.result for run in runs if run.result.trained_on]
    for cpu in sorted({result.trained_on.hardware["cpu"] for result in results}):
        of_cpu = [r.trained_on for r in results if r.trained_on.hardware["cpu"] == cpu]
        commits = sorted({trained_on.versions["commit"] for trained_on in of_cpu})
        yield f"Trained on {cpu}: {len(of_cpu)} policies; commits: {', '.join(commits)}.\n"
    if unknown := [f"`{result.task}`" for result in results if result.demonstrations is None]:
        yield f"Demonstrations and expert labels were not recorded for {', '.join(unknown)}.\n"


def plot_demonstrations(section: Section, path: Path) -> None:
    """Plot the success of last policies over the number of demonstrations, for methods that have
    several in a task; draw nothing where none has."""
    points: dict[str, dict[str, list[tuple[int, ...]]]] = {}
    for group in section.groups:
        number = group.runs[0].result.demonstrations
        method = " ".join(word for word in group.method.split() if word != str(number))
        found = points.setdefault(group.task, {}).setdefault(method, [])
        found.append((number or 0, *group.success))
    panels = {
        task: {
            method: Learning(tuple(zip(*sorted(found), strict=True)))
            for method, found in methods.items()
            if len(found) > 1
        }
        for task, methods in points.items()
    }
    panels = {task: methods for task, methods in panels.items() if methods}
    if panels:
        names = sorted({method for methods in panels.values() for method in methods})
        plot_panels(panels, [path], names=names, xlabel="demonstrations", columns=1)


@own_style()
def plot_tasks(board: Leaderboard, path: Path) -> None:
    """Plot the success of each task's best method with its interval beside that of the expert.

    Text is readable on a telephone, 360 px wide.
    """
    figure = Figure(figsize=(4.4, 0.21 * len(board.tasks) + 1.2), layout="constrained")
    headings = tasks_by_heading(board.tasks)
    heights = [len(tasks) for tasks in headings.values()]
    panels = figure.subplots(len(headings), 1, sharex=True, squeeze=False, height_ratios=heights)
    for axes, (heading, tasks) in zip(panels[:, 0], headings.items(), strict=True):
        axes.set_title(heading, fontsize=9, loc="right")  # longer than the panel is wide
        axes.set_yticks(range(len(tasks)), tasks, fontsize=8)
        axes.set_ylim(len(tasks) - 0.5, -0.5)
        axes.set_xlim(0, 1.02)
        axes.grid(axis="x", color="0.9")
        axes.tick_params(axis="x", labelsize=8)
        for y, task in enumerate(tasks):
            score = describe(task).experts.get("kuka")
            if score:
                axes.plot(score.success_rate, y, "|", color="0.4", markersize=9)
            if groups := board.of_task(task):
                rate, low, high = max(group.success for group in groups)
                axes.plot([low, high], [y, y], color="#0072B2", linewidth=1.5)
                axes.plot(rate, y, "o", color="#0072B2", markersize=4)
            else:
                axes.text(0.01, y, "no policy", fontsize=8, color="0.4", va="center")
    figure.supxlabel("success: policy (dot, 95 % interval), expert (bar)", fontsize=9)
    save(figure, path)


def _rows(board: Leaderboard, task: str) -> Iterator[list[str]]:
    """Yield the rows of a task; numbers of several runs are means."""
    robot = "kuka"
    groups = board.of_task(task)
    if not groups:
        score = describe(task).experts.get(robot)
        yield [f"`{task}`", f"{score.success_rate:.2f}" if score else "", *["–"] * 5]
    for group in groups:
        results = [run.result for run in group.runs]
        score = describe(task).experts.get(results[0].config["env"]["robot"])
        yield [
            f"`{task}`",
            f"{score.success_rate:.2f}" if score else "",
            group.method,
            _unbroken(success_text(group)),
            _mean([result.last.mean_length for result in results], ".1f"),
            _mean([result.env_steps for result in results]),
            _mean([result.seconds and result.seconds / 60 for result in results]),
        ]


def _unbroken(text: str) -> str:
    """Return a text whose intervals stay in one line."""
    return text.replace(" to ", "\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}")


def _origin(runs: Sequence[Run]) -> str:
    """Return the processors and commits of runs, in one line."""
    processors = sorted({r.result.hardware["gpu"] or r.result.hardware["cpu"] for r in runs})
    commits = sorted({run.result.versions.get("commit", "unknown") for run in runs})
    return f"Processors: {', '.join(processors)}; commits: {', '.join(commits)}.\n"


def _mean(values: Sequence[float | None], form: str = ".0f") -> str:
    """Return a mean as text, a dash where a value is not known."""
    known = [value for value in values if value is not None]
    return format(sum(known) / len(known), form) if len(known) == len(values) else "–"


def main() -> None:
    """Add results, and write the page and its figures."""
    if sys.argv[1:]:
        print(f"{add(sys.argv[1:])} results added")
    for name, section in questions().items():
        plot_groups(section.groups, [FOLDER / f"{name}.svg"], columns=1)
        plot_demonstrations(section, FOLDER / f"{name}{OVER_DEMONSTRATIONS}")
    plot_tasks(present(), FOLDER / "tasks.svg")
    PAGE.write_text(page_with_results(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
