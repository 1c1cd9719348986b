"""Report the results of runs: curves with standard errors, tables, and a page with videos.

ba-torchrl report runs/
ba-torchrl report runs=[runs/close_loop_3d,runs/close_loop_4d] folder=report
"""

from __future__ import annotations

from pathlib import Path

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Folders, OutputFolder, check_writable_folder
from ba_torchrl.config import StrictModel
from ba_torchrl.errors import ConfigError
from ba_torchrl.record.report import write_report
from ba_torchrl.record.results import run_folders


class Settings(StrictModel):
    """Settings of this command."""

    runs: Folders = "runs"
    """A folder or a list of folders; the report holds all finished runs below them."""
    folder: OutputFolder | None = None
    """Of the report; null for "report" in the first of the other folders."""


def main(settings: Settings) -> None:
    """Write the report and print its tables."""
    folder = Path(settings.folder or Path(settings.runs[0]) / "report")
    if not run_folders(settings.runs)[0]:
        raise ConfigError(f"no finished run below {', '.join(settings.runs)}")
    check_writable_folder(folder)
    page = write_report(settings.runs, folder)
    print((page.parent / "table.md").read_text(encoding="utf-8"))
    print(f"  page    {page}")
    print(f"  tables  {page.parent / 'table.csv'}, {page.parent / 'table.md'}")


COMMAND = Command(main, Settings, positional="runs")
