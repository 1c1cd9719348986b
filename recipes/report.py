"""Report the results of runs: curves with standard errors, tables, and a page with videos.

python recipes/report.py runs/
python recipes/report.py runs=[runs/close_loop_3d,runs/close_loop_4d] folder=report
"""

import sys
from pathlib import Path

import hydra

from ba_torchrl.config import StrictModel
from ba_torchrl.errors import ConfigError
from ba_torchrl.record.report import write_report
from ba_torchrl.record.results import run_folders
from ba_torchrl.training.command_line import Folders, OutputFolder, check_writable_folder, command


class Settings(StrictModel):
    """Settings of this command."""

    runs: Folders
    folder: OutputFolder | None


@hydra.main(config_path="../configs", config_name="report", version_base="1.3")
@command(Settings)
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


if __name__ == "__main__":
    # folders may be positional: report.py runs/a runs/b
    folders = [argument for argument in sys.argv[1:] if "=" not in argument and argument[:1] != "-"]
    if folders:
        others = [argument for argument in sys.argv[1:] if argument not in folders]
        sys.argv[1:] = [f"runs=[{','.join(folders)}]", *others]
    main()
