"""Write the page of tasks: description, conditions of success and parameters of each.

python recipes/tasks.py path=docs/tasks.md
"""

from pathlib import Path

import hydra

from ba_torchrl.config import StrictModel
from ba_torchrl.record.task_page import task_page
from ba_torchrl.training.command_line import OutputFile, Plugins, Tasks, command


class Settings(StrictModel):
    """Settings of this command."""

    plugins: Plugins
    tasks: Tasks
    path: OutputFile


@hydra.main(config_path="../configs", config_name="tasks", version_base="1.3")
@command(Settings)
def main(settings: Settings) -> None:
    """Write the page."""
    path = Path(settings.path)
    path.write_text(task_page(settings.tasks), encoding="utf-8")
    print(path)


if __name__ == "__main__":
    main()
