"""Write results.md and its curves from the results of finished runs in docs/results.

python -m docs.results                        # the page
python -m docs.results runs/cpu_close_loop    # copy the results of these runs first

Of a run, `result.json` (curve, final evaluation, machine, versions) and `config.json` are kept, in
the folders of its grid. `ba-torchrl report docs/results` makes a report of them.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator

from ba_torchrl.commands.report import completed
from ba_torchrl.envs.description import describe
from ba_torchrl.record.report import plot_section
from ba_torchrl.record.results import (
    CONFIG_FILE,
    RESULT_FILE,
    read_result,
    run_folders,
    wilson_interval,
)
from ba_torchrl.record.summary import OTHER_RUNS, Group, Run, Section, load_sections
from ba_torchrl.record.task_page import tasks_by_heading
from ba_torchrl.training.policy import read_card, shipped_file
from docs.sources import ROOT

PAGE = ROOT / "docs" / "results.md"
FOLDER = ROOT / "docs" / "results"
BEGIN, END = "<!-- results: begin -->\n", "<!-- results: end -->\n"
HEADER = (
    "task",
    "",
    "expert",
    "method",
    "seed",
    "success of the policy",
    "steps",
    "update",
    "updates",
    "environment steps",
    "minutes",
    "commit",
)


def copy(roots: list[str]) -> int:
    """Copy the results of the finished runs below some folders into docs/results.

    Returns:
        Their number.
    """
    finished, _ = run_folders(roots)
    for folder in finished:
        benchmark = read_result(folder).benchmark or "other"
        target = FOLDER.joinpath(benchmark, *folder.resolve().parts[-3:])
        target.mkdir(parents=True, exist_ok=True)
        for name in (RESULT_FILE, CONFIG_FILE):
            shutil.copyfile(folder / name, target / name)
    return len(finished)


def sections() -> list[Section]:
    """Return the runs of each benchmark in docs/results, in the order of their names."""
    return [
        each for each in load_sections([FOLDER], completed=completed)[0] if each.title != OTHER_RUNS
    ]


def page_with_results(text: str) -> str:
    """Return the page with tables of the present results."""
    start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    parts = ["\n".join(_section(section)) for section in sections()]
    return text[:start] + "\n" + "\n\n".join(parts) + "\n\n" + text[end:]


def _section(section: Section) -> Iterator[str]:
    name = section.title
    runs = [run.result for group in section.groups for run in group.runs]
    cpus = sorted({run.hardware["cpu"] for run in runs})
    marks = {cpu: f" ({'abcdefgh'[number]})" if cpus[1:] else "" for number, cpu in enumerate(cpus)}
    days = sorted({run.finished[:10] for run in runs})
    yield f"## {', '.join(tasks_by_heading(section.tasks))} (`{name}`)\n"
    yield f"`ba-torchrl benchmark benchmark={name} threads=1 jobs=2`;"
    yield f"{', '.join(cpu + mark for cpu, mark in marks.items())}; {days[0]} to {days[-1]}.\n"
    yield f"![Success over updates](results/{name}.svg)\n"
    yield f"| {' | '.join(HEADER)} |"
    yield "|" + "---|" * len(HEADER)
    before = ""
    for group in section.groups:
        for run in group.runs:
            yield f"| {' | '.join(_cells(group, run, marks, is_first=group.task != before))} |"
            before = group.task


def _cells(group: Group, run: Run, marks: dict[str, str], *, is_first: bool) -> list[str]:
    """Return the row of a run; the first one of a task has its picture.

    Args:
        marks: what stands behind the minutes, by processor.
    """
    result, task = run.result, group.task
    final, score = result.final, describe(task).experts.get(result.config["env"]["robot"])
    low, high = wilson_interval(round(final.success_rate * final.episodes), final.episodes)
    success = f"{final.success_rate:.2f} ({low:.2f} to {high:.2f})"
    return [
        f"`{task}`",
        f'<img src="gallery/{task.replace("/", "_")}.png" width="160">' if is_first else "",
        "" if score is None else f"{score.success_rate:.2f}",
        group.method + (", **shipped**" if _is_shipped(run) else ""),
        str(result.seed),
        success,
        f"{final.mean_length:.1f}",
        str(final.updates),
        str(result.curve[-1].updates),
        str(result.curve[-1].env_steps),
        f"{result.seconds / 60:.0f}{marks[result.hardware['cpu']]}",
        result.versions.get("commit", ""),
    ]


def _is_shipped(run: Run) -> bool:
    """Return whether the policy that the package ships for the task is of this run."""
    path = shipped_file(run.result.task)
    if not path.exists():
        return False
    card = read_card(path)
    same = (card.label, card.config["seed"], card.versions) == (
        run.result.label,
        run.result.seed,
        run.result.versions,
    )
    return same and card.updates == run.result.final.updates


def main() -> None:
    """Copy results, and write the page and its curves."""
    if sys.argv[1:]:
        print(f"{copy(sys.argv[1:])} runs copied")
    for section in sections():
        plot_section(section, [FOLDER / f"{section.title}.svg"])
    PAGE.write_text(page_with_results(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
