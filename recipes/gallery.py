"""Draw the tasks: an episode of each expert, and one picture of all tasks.

python recipes/gallery.py                       # pictures in runs/gallery
python recipes/gallery.py folder=docs/gallery overview=docs/gallery.png  # those of the README
python recipes/gallery.py tasks=[close_loop/block_picking] folder=pictures overview=null
"""

from pathlib import Path

import hydra
from tqdm import tqdm

from ba_torchrl import list_tasks
from ba_torchrl.config import StrictModel
from ba_torchrl.record.gallery import expert_strip, overview_figure, strip_figure
from ba_torchrl.training.command_line import (
    Count,
    OutputFolder,
    Plugins,
    PngFile,
    Seed,
    Structures,
    Tasks,
    command,
)


class Settings(StrictModel):
    """Settings of this command."""

    plugins: Plugins
    tasks: Tasks
    deconstructions: Structures
    seed: Seed
    pictures: Count
    folder: OutputFolder
    overview: PngFile | None


@hydra.main(config_path="../configs", config_name="gallery", version_base="1.3")
@command(Settings)
def main(settings: Settings) -> None:
    """Play one episode per task and write its pictures."""
    strips = {}
    for task in tqdm(settings.tasks or list_tasks(), unit="task"):
        strips[task] = expert_strip(task, settings.seed, settings.pictures)
        path = Path(settings.folder) / f"{task.replace('/', '_')}.png"
        tqdm.write(str(strip_figure(task, strips[task], path)))
    for task in settings.deconstructions:
        strip = expert_strip(task, settings.seed, settings.pictures, deconstruct=True)
        path = Path(settings.folder) / f"{task.replace('/', '_')}_deconstruction.png"
        print(strip_figure(f"{task}, deconstruction", strip, path))
    if settings.overview is not None:
        print(overview_figure(strips, settings.overview))


if __name__ == "__main__":
    main()
