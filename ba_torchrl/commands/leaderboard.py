"""Print success by task and method: the package's records and finished runs beside them.

ba-torchrl leaderboard
ba-torchrl leaderboard runs
ba-torchrl leaderboard 'runs=[runs,my_runs]' 'plugins=[my_tasks]' format=markdown
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from ba_torchrl import list_tasks
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Folders, PluginSettings
from ba_torchrl.commands.report import completed
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.leaderboard import LEGEND, Leaderboard, leaderboard, package_runs
from ba_torchrl.record.results import why_unfinished
from ba_torchrl.record.summary import load_runs, pipes


class Settings(PluginSettings):
    """Settings of this command."""

    runs: Folders | None = None
    """A folder or a list of folders with finished runs; null for the package's records alone."""
    format: Literal["text", "markdown"] = "text"
    """Of the table."""


def main(settings: Settings) -> None:
    """Print the table."""
    board, unfinished = read(settings.runs or ())
    rows = board.rows()
    if settings.format == "markdown":
        print("\n".join(pipes(*rows)))
    else:
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for row in rows:
            padded = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            print("  ".join(padded).rstrip())
    print(f"\n{LEGEND}")
    left_out = [*board.left_out, *(f"{folder}: {why_unfinished(folder)}" for folder in unfinished)]
    if left_out:
        print("\n".join(["\nLeft out:", *(f"- {run}" for run in left_out)]))


def read(roots: Sequence[str]) -> tuple[Leaderboard, list[Path]]:
    """Return the table with the runs below some folders, and the folders of unfinished runs."""
    from ba_torchrl.training.protocol import PROTOCOL  # imports torch, which takes seconds

    own, unfinished = load_runs(roots, completed)
    if roots and not own and not unfinished:
        raise ConfigError(f"no run below {', '.join(roots)}")
    return leaderboard(package_runs(completed), own, list_tasks(), PROTOCOL), unfinished


COMMAND = Command(main, Settings, positional="runs")
