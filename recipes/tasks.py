"""Write the page of tasks: description, conditions of success and parameters of each.

python recipes/tasks.py path=docs/tasks.md
"""

from pathlib import Path

import hydra
from omegaconf import DictConfig

from ba_torchrl.plugins import load_plugins
from ba_torchrl.record.task_page import task_page
from ba_torchrl.training.command_line import (
    check_known,
    check_tasks,
    check_texts,
    check_writable_file,
    plain_errors,
)


@hydra.main(config_path="../configs", config_name="tasks", version_base="1.3")
@plain_errors
def main(settings: DictConfig) -> None:
    """Write the page."""
    check_known(settings)
    load_plugins(settings.plugins)
    check_tasks(settings)
    check_texts(settings, "path")
    check_writable_file(settings.path)
    path = Path(settings.path)
    path.write_text(task_page(list(settings.tasks) if settings.tasks else None), encoding="utf-8")
    print(path)


if __name__ == "__main__":
    main()
