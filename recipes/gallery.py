"""Draw the tasks: an episode of each expert, and one picture of all tasks.

python recipes/gallery.py                       # pictures in runs/gallery
python recipes/gallery.py folder=docs/gallery overview=docs/gallery.png overwrite=true
python recipes/gallery.py 'tasks=[close_loop/block_picking]' folder=pictures overview=null
"""

from pathlib import Path

from pydantic import Field
from tqdm import tqdm

from ba_torchrl import list_tasks
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import (
    Count,
    OutputFolder,
    PluginSettings,
    PngFile,
    Seed,
    Structures,
    Tasks,
    check_untracked,
)
from ba_torchrl.record.gallery import expert_strip, overview_figure, strip_figure


class Settings(PluginSettings):
    """Settings of this command."""

    tasks: Tasks = None
    """Ids of tasks; null for all."""
    deconstructions: Structures = Field(["open_loop/house_building_4"])
    """Structures whose deconstruction is drawn."""
    seed: Seed = 5
    """Of the episodes."""
    pictures: Count = 4
    """Of each episode."""
    folder: OutputFolder = "runs/gallery"
    """Of the pictures."""
    overview: PngFile | None = "runs/gallery/all_tasks.png"
    """Picture of all tasks, or null."""
    overwrite: bool = False
    """Also write over files that git tracks."""


def main(settings: Settings) -> None:
    """Play one episode per task and write its pictures."""
    folder, strips = Path(settings.folder), {}
    files = {
        task: folder / f"{task.replace('/', '_')}.png" for task in settings.tasks or list_tasks()
    }
    apart = {
        task: folder / f"{task.replace('/', '_')}_deconstruction.png"
        for task in settings.deconstructions
    }
    if not settings.overwrite:
        overview = [settings.overview] if settings.overview else []
        check_untracked([*files.values(), *apart.values(), *overview])
    for task, path in tqdm(files.items(), unit="task"):
        strips[task] = expert_strip(task, settings.seed, settings.pictures)
        tqdm.write(str(strip_figure(task, strips[task], path)))
    for task, path in apart.items():
        strip = expert_strip(task, settings.seed, settings.pictures, deconstruct=True)
        print(strip_figure(f"{task}, deconstruction", strip, path))
    if settings.overview is not None:
        print(overview_figure(strips, settings.overview))


COMMAND = Command(main, Settings, positional="tasks")

if __name__ == "__main__":
    COMMAND.run()
