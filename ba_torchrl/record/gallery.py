"""Figures of tasks: rendered images of the expert's episode, and the policy's observation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from ba_torchrl import make
from ba_torchrl.core import keys
from ba_torchrl.core.files import replaced
from ba_torchrl.demonstrations.time_reversal import make_deconstruction_env
from ba_torchrl.record.task_page import tasks_by_heading
from ba_torchrl.record.video import FrameRecorder

_CELL_IN = 1.62
"""Width of an image in a figure."""
_TITLE_IN = 0.3
"""Height of a title above images."""
_HEADING_IN = 0.5
"""Height of a heading above a group of tasks."""
_BORDER_IN = 0.02
"""Empty border of an image."""
_SPACE_IN = 0.15
"""Distance between the images of two tasks."""
_DPI = 120
_COLORS = 256
"""Number of colours of a file, which halves its size."""


class Strip(NamedTuple):
    """Rendered images of an episode."""

    pictures: list[np.ndarray]
    """[H, W, 3] uint8, from the initial to the final state."""
    first_image: np.ndarray
    """The policy's first observation, [H, W] metres."""


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


def strip_figure(name: str, strip: Strip, path: str | Path) -> Path:
    """Write a row of images: the policy's first observation, then the expert's episode."""
    images = [strip.first_image, *strip.pictures]
    sheet = _Sheet(len(images) * _CELL_IN, _TITLE_IN + _CELL_IN)
    sheet.add_row(name, images, 0.0, 0.0)
    return sheet.write(path)


def overview_figure(strips: Mapping[str, Strip], path: str | Path, columns: int = 4) -> Path:
    """Write the initial and the final state of tasks, by id, under the headings of their groups."""
    groups = tasks_by_heading(strips)
    row_in, pair_in = _TITLE_IN + _CELL_IN, 2 * _CELL_IN + _SPACE_IN
    rows = sum(math.ceil(len(tasks) / columns) for tasks in groups.values())
    sheet = _Sheet(columns * pair_in - _SPACE_IN, rows * row_in + len(groups) * _HEADING_IN)
    top_in = 0.0
    for heading, tasks in groups.items():
        sheet.add_heading(heading, top_in)
        top_in += _HEADING_IN
        titles = _titles(tasks)
        for index, task in enumerate(tasks):
            row, column = divmod(index, columns)
            pictures = [strips[task].pictures[0], strips[task].pictures[-1]]
            sheet.add_row(titles[task], pictures, column * pair_in, top_in + row * row_in)
        top_in += math.ceil(len(tasks) / columns) * row_in
    return sheet.write(path)


def _titles(tasks: Sequence[str]) -> dict[str, str]:
    """Return the title of each task of a heading: its name, with its group if there are several."""
    groups = {task.split("/")[0] for task in tasks}
    shown = {task: task if len(groups) > 1 else task.split("/")[-1] for task in tasks}
    return {task: title.replace("_", " ").replace("/", ": ") for task, title in shown.items()}


class _Sheet:
    """A figure with images and headings at given positions, measured from its upper left corner."""

    def __init__(self, width_in: float, height_in: float) -> None:
        self.size_in = np.array([width_in, height_in])
        self.figure = Figure(figsize=(width_in, height_in), dpi=_DPI)
        self.canvas = FigureCanvasAgg(self.figure)

    def add_heading(self, text: str, top_in: float) -> None:
        """Add a heading of the height `_HEADING_IN`."""
        self._add_text(text, _BORDER_IN, top_in + _HEADING_IN - 0.1, size=14, weight="bold")

    def add_row(
        self, title: str, images: Sequence[np.ndarray], left_in: float, top_in: float
    ) -> None:
        """Add a title of the height `_TITLE_IN` and square images of the width `_CELL_IN`.

        The images are [H, W] or [H, W, 3]; the upper left corner is that of the title.
        """
        self._add_text(title, left_in + _BORDER_IN, top_in + _TITLE_IN - 0.02, size=9)
        size = (_CELL_IN - 2 * _BORDER_IN) / self.size_in
        bottom_in = self.size_in[1] - top_in - _TITLE_IN - _CELL_IN
        for column, image in enumerate(images):
            corner_in = (left_in + column * _CELL_IN + _BORDER_IN, bottom_in + _BORDER_IN)
            axes = self.figure.add_axes((*corner_in / self.size_in, *size))
            axes.set_axis_off()
            axes.imshow(image, cmap="gray", interpolation="antialiased")

    def _add_text(self, text: str, left_in: float, bottom_in: float, **style: Any) -> None:
        x, y = np.array([left_in, self.size_in[1] - bottom_in]) / self.size_in
        self.figure.text(x, y, text, va="bottom", **style)

    def write(self, path: str | Path) -> Path:
        """Write the figure as a PNG with a palette."""
        path = Path(path)
        self.canvas.draw()
        image = Image.fromarray(np.asarray(self.canvas.buffer_rgba())[..., :3])
        picture = image.quantize(_COLORS, kmeans=2, dither=Image.Dither.NONE)
        with replaced(path) as scratch:
            picture.save(scratch, optimize=True)
        return path
