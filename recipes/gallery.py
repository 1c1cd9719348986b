"""Draw the tasks: a picture and a film of each, and one picture of all.

python recipes/gallery.py                       # in runs/gallery
python recipes/gallery.py folder=docs/gallery overview=docs/gallery.png films=true
python recipes/gallery.py 'tasks=[close_loop/block_picking]' folder=pictures overview=null

A file that exists is refused: delete the pictures of a page before they are drawn again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from PIL import Image, ImageDraw
from pydantic import Field
from tqdm import tqdm

from ba_torchrl import list_tasks, load_policy, make
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import (
    OutputFolder,
    PluginSettings,
    PngFile,
    Seed,
    Tasks,
    check_new,
    checked,
)
from ba_torchrl.core import keys
from ba_torchrl.core.files import atomic_file
from ba_torchrl.demonstrations.time_reversal import make_deconstruction_env
from ba_torchrl.envs.description import tasks_by_heading
from ba_torchrl.envs.policies import expert_policy
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.record.results import shipped_policies
from ba_torchrl.record.video import FrameRecorder
from ba_torchrl.tasks.structures.open_loop import check_has_structure
from ba_torchrl.training.evaluation import record_episodes

STILL = 240
"""Width of the picture of a task, in pixels."""
MOST_FRAMES, MOST_BYTES, QUALITIES = 40, 200_000, (50, 40, 30)
"""Of a film, a WebP file: the first quality that is small enough, or the last."""
ATTEMPTS = 5
"""Episodes after which a film shows one that failed."""
CELL, TITLE, HEADING, SPACE = 194, 36, 60, 18
"""Width of an image, height of a title above images and of a heading above a group of tasks, and
distance between the images of two tasks, in pixels."""
COLUMNS = 4
"""Tasks in a row of the picture of all tasks."""
COLORS = 256
"""Number of colours of a file, which halves its size."""


class Settings(PluginSettings):
    """Settings of this command."""

    tasks: Tasks = None
    """Ids of tasks; null for all."""
    deconstructions: list[Annotated[str, checked(check_has_structure)]] = Field(
        ["open_loop/house_building_4"]
    )
    """Structures whose deconstruction is drawn."""
    seed: Seed = 5
    """Of the episodes."""
    films: bool = False
    """Also write a film of each task: TASK.webp by the policy that the package ships, or
    TASK_expert.webp."""
    folder: OutputFolder = "runs/gallery"
    """Of pictures and films."""
    overview: PngFile | None = "runs/gallery/all_tasks.png"
    """Picture of all tasks, or null."""


class Strip(NamedTuple):
    """Rendered images of an episode."""

    pictures: list[np.ndarray]
    """[H, W, 3] uint8, from the initial to the final state."""
    first_image: np.ndarray
    """The policy's first observation, [H, W] metres."""


def main(settings: Settings) -> None:
    """Play one episode per task and write its picture, and its film."""
    folder, strips = Path(settings.folder), {}
    files = {
        task: folder / f"{task.replace('/', '_')}.png" for task in settings.tasks or list_tasks()
    }
    films = {task: film_path(task, path) for task, path in files.items() if settings.films}
    apart = {
        task: folder / f"{task.replace('/', '_')}_deconstruction.png"
        for task in settings.deconstructions
    }
    overview = [] if settings.overview is None else [settings.overview]
    for path in [*files.values(), *films.values(), *apart.values(), *overview]:
        check_new(path)
    for task, path in tqdm(files.items(), unit="task"):
        strip = strips[task] = expert_strip(task, settings.seed, pictures=2)
        still = Image.fromarray(strip.pictures[-1]).resize((STILL, STILL))
        tqdm.write(str(write(still, path)))
        if task in films:
            frames, milliseconds = film_frames(task, settings.seed)
            tqdm.write(str(write_film(frames, milliseconds, films[task])))
    for task, path in apart.items():
        strip = expert_strip(task, settings.seed, pictures=2, deconstruct=True)
        print(write(labelled(f"{task}, deconstruction", strip.pictures), path))
    for path in overview:
        print(write(overview_of(strips), Path(path)))


def expert_strip(task: str, seed: int, pictures: int = 4, *, deconstruct: bool = False) -> Strip:
    """Play an episode with the expert and render at most a number of images.

    They are evenly spaced from the initial to the final state; those between show grasps and
    releases if the task is open-loop. ``deconstruct`` takes the structure apart.
    """
    make_env = make_deconstruction_env if deconstruct else make
    env = make_env(task, expert=True, seed=seed)
    recorder = FrameRecorder(env)
    try:
        state = env.reset()
        first = state[next(iter(env.images))][0].numpy()
        recorder.record()
        while not state[keys.DONE]:
            action = state[keys.EXPERT_ACTION]
            state = env.step(state.set(keys.ACTION, action))[keys.NEXT]
            recorder.record()
    finally:
        env.close()
    last = len(recorder.frames) - 1
    between = np.linspace(0, last, pictures)[1:-1].round().astype(int).tolist()
    if recorder.contacts:
        between = [min(recorder.contacts, key=lambda i: abs(i - wanted)) for wanted in between]
    chosen = [*dict.fromkeys([0, *between]), last][:pictures]
    return Strip([recorder.frames[i] for i in chosen], first)


def film_path(task: str, picture: Path) -> Path:
    """Return the file of a task's film, beside its picture."""
    return picture.with_name(
        picture.stem + ("" if task in shipped_policies() else "_expert") + ".webp"
    )


def film_frames(task: str, seed: int) -> tuple[list[np.ndarray], float]:
    """Return the images of a successful episode, and the milliseconds of each.

    It is of the shipped policy, or of the expert where there is none.
    """
    if task in shipped_policies():
        policy = load_policy(task)
        resolved = policy.config.env
    else:
        policy, resolved = expert_policy, resolve_env(task, {"expert": True})
    succeeded: list[bool] = []
    for attempt in range(ATTEMPTS):
        frames = record_episodes(
            resolved, policy, 1, seed + attempt, on_episode=lambda *end: succeeded.append(end[-1])
        )
        if succeeded[-1]:
            break
    return frames, 1000 / resolved.video_fps


def write_film(frames: Sequence[np.ndarray], milliseconds: float, path: Path) -> Path:
    """Write images as a small WebP of the same duration with at most `MOST_FRAMES` images."""
    step = math.ceil(len(frames) / MOST_FRAMES)
    first, *others = (Image.fromarray(frame) for frame in frames[(len(frames) - 1) % step :: step])
    with atomic_file(path) as scratch:
        for quality in QUALITIES:
            first.save(
                scratch,
                format="WEBP",
                save_all=True,
                append_images=others,
                duration=round(step * milliseconds),
                quality=quality,
                loop=0,
            )
            if scratch.stat().st_size <= MOST_BYTES:
                break
    return path


def labelled(title: str, images: Sequence[np.ndarray]) -> Image.Image:
    """Return a row of images, [H, W] of any range or [H, W, 3] uint8, below a title."""
    row = _white(len(images) * CELL, TITLE + CELL)
    ImageDraw.Draw(row).text((2, TITLE - 2), title, "black", anchor="ls", font_size=15)
    for column, image in enumerate(images):
        if image.ndim == 2:
            image = (255 * (image - image.min()) / (np.ptp(image) or 1)).astype(np.uint8)
        picture = Image.fromarray(image).convert("RGB")
        row.paste(picture.resize((CELL - 4, CELL - 4)), (column * CELL + 2, TITLE + 2))
    return row


def overview_of(strips: Mapping[str, Strip]) -> Image.Image:
    """Return the initial and the final state of tasks, by id, under the headings of their groups.

    The title of a task is its name, with its group where a heading has several.
    """
    groups = tasks_by_heading(strips)
    tops = [0]
    for tasks in groups.values():
        tops.append(tops[-1] + HEADING + math.ceil(len(tasks) / COLUMNS) * (TITLE + CELL))
    sheet = _white(COLUMNS * (2 * CELL + SPACE) - SPACE, tops[-1])
    for top, (heading, tasks) in zip(tops, groups.items(), strict=False):
        at = (2, top + HEADING - 12)
        ImageDraw.Draw(sheet).text(at, heading, "black", anchor="ls", font_size=23)
        has_several = len({task.split("/")[0] for task in tasks}) > 1
        for index, task in enumerate(tasks):
            row, column = divmod(index, COLUMNS)
            title = (task if has_several else task.split("/")[-1]).replace("_", " ")
            pictures = strips[task].pictures
            pair = labelled(title.replace("/", ": "), [pictures[0], pictures[-1]])
            left = column * (2 * CELL + SPACE)
            sheet.paste(pair, (left, top + HEADING + row * (TITLE + CELL)))
    return sheet


def write(picture: Image.Image, path: Path) -> Path:
    """Write a picture as a PNG with a palette."""
    small = picture.quantize(COLORS, kmeans=2, dither=Image.Dither.NONE)
    with atomic_file(path) as scratch:
        small.save(scratch, format="PNG", optimize=True)
    return path


def _white(width: int, height: int) -> Image.Image:
    return Image.new("RGB", (width, height), "white")


COMMAND = Command(main, Settings, positional="tasks")

if __name__ == "__main__":
    COMMAND.run()
