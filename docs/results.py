"""Write results.md and its curves from the package's records.

python -m docs.results                        # the page
python -m docs.results runs/cpu_close_loop    # add the records of these runs first

A record is the `result.json` of a finished run, or the test of a policy (`docs.shipped`), in
ba_torchrl/results.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence

from ba_torchrl.commands.report import completed
from ba_torchrl.core.files import write_text
from ba_torchrl.envs.description import describe
from ba_torchrl.record.leaderboard import (
    LEGEND,
    RECORDS,
    Leaderboard,
    cell_text,
    leaderboard,
    package_runs,
)
from ba_torchrl.record.report import pipes, plot_groups
from ba_torchrl.record.summary import Group, Run, load_runs
from ba_torchrl.record.task_page import tasks_by_heading
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.protocol import PROTOCOL
from docs.sources import ROOT

PAGE = ROOT / "docs" / "results.md"
FOLDER = ROOT / "docs" / "results"
BEGIN, END = "<!-- results: begin -->\n", "<!-- results: end -->\n"
HEADER = (
    "task",
    "",
    "expert",
    "method",
    "success",
    "best",
    "steps",
    "demonstrations",
    "environment steps",
    "minutes",
    "processors",
    "commit",
)


def add(roots: Sequence[str]) -> int:
    """Write the records of the finished runs below some folders into the package.

    Returns:
        Their number.

    Raises:
        ValueError: runs have the same task, label and seed, and with them the same file.
    """
    named: dict[str, Run] = {}
    for run in load_runs(roots)[0]:
        name = f"{run.result.task} {run.result.label} seed{run.result.seed}"
        name = "".join(c if c.isalnum() or c in "-." else "_" for c in name) + ".json"
        if name in named:
            raise ValueError(f"{named[name].folder} and {run.folder} are both {name}")
        named[name] = run
    for name, run in named.items():
        write_text(RECORDS / name, run.result.model_dump_json() + "\n")
    return len(named)


def present() -> Leaderboard:
    """Return the package's records by task and method, tasks of plugins left out."""
    tasks = [task for task in TASKS if TASKS.plugin_module(task) is None]
    return leaderboard(package_runs(completed), [], tasks, PROTOCOL)


def page_with_results(text: str) -> str:
    """Return the page with tables of the present records."""
    start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    board = present()
    header, *rows = board.rows()
    parts = [f"{LEGEND}\n", *pipes(header, ([f"`{task}`", *cells] for task, *cells in rows)), ""]
    if board.left_out:
        parts += ["Left out:", "", *(f"- {run}" for run in board.left_out), ""]
    for heading, groups in _by_heading(board).items():
        parts += _section(heading, groups)
    return text[:start] + "\n" + "\n".join(parts) + "\n" + text[end:]


def _by_heading(board: Leaderboard) -> dict[str, list[Group]]:
    """Return the rows of each group of tasks that has one."""
    found = {
        heading: [
            board.cells[task, method]
            for task in tasks
            for method in board.methods
            if (task, method) in board.cells
        ]
        for heading, tasks in tasks_by_heading(board.tasks).items()
    }
    return {heading: groups for heading, groups in found.items() if groups}


def _figure(heading: str) -> str:
    """Return the name of the figure of a group of tasks."""
    return heading.split(":")[0].lower().replace(" ", "_") + ".svg"


def _section(heading: str, groups: Sequence[Group]) -> Iterator[str]:
    yield f"## {heading}\n"
    if any(_has_curve(group) for group in groups):
        yield f"![Success over environment steps](results/{_figure(heading)})\n"
    yield from pipes(HEADER, map(_cells, groups))
    yield ""


def _has_curve(group: Group) -> bool:
    return any(run.result.curve for run in group.runs)


def _cells(group: Group) -> list[str]:
    """Return the row of a task and a method; numbers of several runs are means."""
    results, task = [run.result for run in group.runs], group.task
    score = describe(task).experts.get(results[0].config["env"]["robot"])
    return [
        f"`{task}`",
        f'<img src="gallery/{task.replace("/", "_")}.png" width="160">',
        "" if score is None else f"{score.success_rate:.2f}",
        group.method,
        cell_text(group),
        _mean([result.best.success_rate for result in results], ".2f"),
        _mean([result.last.mean_length for result in results], ".1f"),
        _mean([result.demonstrations for result in results]),
        _mean([result.env_steps for result in results]),
        _mean([result.seconds and result.seconds / 60 for result in results]),
        ", ".join(sorted({result.hardware["gpu"] or result.hardware["cpu"] for result in results})),
        ", ".join(sorted({result.versions.get("commit", "") for result in results})),
    ]


def _mean(values: Sequence[float | None], form: str = ".0f") -> str:
    """Return a mean as text, a dash where a value is not known."""
    known = [value for value in values if value is not None]
    return format(sum(known) / len(known), form) if len(known) == len(values) else "–"


def main() -> None:
    """Add records, and write the page and its curves."""
    if sys.argv[1:]:
        print(f"{add(sys.argv[1:])} records added")
    for heading, groups in _by_heading(present()).items():
        if any(_has_curve(group) for group in groups):
            with_curve = [group for group in groups if _has_curve(group)]
            plot_groups(with_curve, [FOLDER / _figure(heading)])
    PAGE.write_text(page_with_results(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
