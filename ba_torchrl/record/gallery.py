"""Figures of tasks: rendered images of the expert's episode, and the policy's observation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ba_torchrl import make
from ba_torchrl.envs import keys


class Strip(NamedTuple):
    """Rendered images of an episode."""

    pictures: list[np.ndarray]
    """[H, W, 3] uint8, from the initial to the final state."""
    first_image: np.ndarray
    """The policy's first observation, [H, W] metres."""


def expert_strip(task: str, seed: int, pictures: int = 4, *, deconstruct: bool = False) -> Strip:
    """Play an episode with the expert and render it.

    Args:
        task: id of the task.
        seed: of the episode.
        pictures: number of images, evenly spaced from the initial to the final state.
        deconstruct: whether the episode takes the structure apart.
    """
    env = make(task, expert=True, seed=seed, deconstruct=deconstruct)
    try:
        state = env.reset()
        first = state[keys.PIXELS][0].numpy()
        frames = [env.render(480, 400)]
        while not state[keys.DONE]:
            action = state[keys.EXPERT_ACTION]
            state = env.step(state.set(keys.ACTION, action))[keys.NEXT]
            frames.append(env.render(480, 400))
    finally:
        env.close()
    chosen = np.linspace(0, len(frames) - 1, pictures).round().astype(int)
    return Strip([frames[i] for i in chosen], first)


def strip_figure(name: str, strip: Strip, path: str | Path) -> Path:
    """Write a row of images: the policy's first observation, then the expert's episode.

    Args:
        name: title.
        strip: the episode, from `expert_strip`.
        path: the PNG to write.
    """
    columns = 1 + len(strip.pictures)
    figure, axes = _canvas(1, columns, (2.6 * columns, 2.35))
    axes[0].imshow(strip.first_image, cmap="gray")
    axes[0].set_title(name, fontsize=11, loc="left")
    for axis, picture in zip(axes[1:], strip.pictures, strict=True):
        axis.imshow(picture)
    return _write(figure, path, dpi=80)


def overview_figure(strips: Mapping[str, Strip], path: str | Path, columns: int = 5) -> Path:
    """Write a grid with one image per task, from the middle of the expert's episode.

    Args:
        strips: the episode from `expert_strip`, by task.
        path: the PNG to write.
        columns: number of images per row.
    """
    rows = math.ceil(len(strips) / columns)
    figure, axes = _canvas(rows, columns, (2.6 * columns, 2.5 * rows))
    for axis, (name, strip) in zip(axes, strips.items(), strict=False):
        axis.imshow(strip.pictures[len(strip.pictures) // 2])
        axis.set_title(name.split("/")[-1].replace("_", " "), fontsize=9)
    return _write(figure, path, dpi=80)


def _canvas(rows: int, columns: int, size_in: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=size_in, layout="constrained")
    FigureCanvasAgg(figure)
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis in axes:
        axis.set_axis_off()
    return figure, axes


def _write(figure: Figure, path: str | Path, dpi: int) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    return path
