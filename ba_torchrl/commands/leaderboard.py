"""Print success by task and method: the shipped policies, and finished runs beside them.

ba-torchrl leaderboard
ba-torchrl leaderboard runs
ba-torchrl leaderboard 'runs=[runs,my_runs]' 'plugins=[my_tasks]'
"""

from __future__ import annotations

from ba_torchrl import list_tasks
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Folders, PluginSettings
from ba_torchrl.commands.report import completed
from ba_torchrl.core.config import PROTOCOL
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.leaderboard import LEGEND, leaderboard, read_results
from ba_torchrl.record.results import why_unfinished
from ba_torchrl.record.summary import load_runs, markdown, pipes


class Settings(PluginSettings):
    """Settings of this command."""

    runs: Folders | None = None
    """A folder or a list of folders with finished runs; null for the shipped policies alone."""


def main(settings: Settings) -> None:
    """Print the table."""
    shipped, roots = read_results(), settings.runs or ()
    own, unfinished = load_runs(roots)
    if roots and not own and not unfinished:
        raise ConfigError(f"no run below {', '.join(roots)}")
    board = leaderboard(completed(shipped), completed(own), list_tasks(), PROTOCOL)
    rows = list(board.rows())
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = ([c.ljust(width) for c, width in zip(row, widths, strict=True)] for row in rows)
    print("\n".join(pipes(*padded)))
    print(f"\n{LEGEND}")
    left_out = [*board.left_out, *(f"{folder}: {why_unfinished(folder)}" for folder in unfinished)]
    if left_out:
        print("\n".join(["\nLeft out:", *(f"- {markdown(run)}" for run in left_out)]))


COMMAND = Command(main, Settings, positional="runs")
