"""Draw the tasks: a contact sheet of the experts at work.

python recipes/gallery.py                       # docs/gallery.png, every task
python recipes/gallery.py tasks=[close_loop/block_picking] path=picking.png
"""

import hydra
from omegaconf import DictConfig
from tqdm import tqdm

from ba_torchrl import list_tasks
from ba_torchrl.record.gallery import contact_sheet, expert_strip


@hydra.main(config_path="../configs", config_name="gallery", version_base="1.3")
def main(settings: DictConfig) -> None:
    """Play one episode per task and write the sheet."""
    tasks = settings.tasks or list_tasks()
    rows = [(task, *expert_strip(task, settings.seed)) for task in tqdm(tasks, unit="task")]
    print(contact_sheet(rows, settings.path))


if __name__ == "__main__":
    main()
