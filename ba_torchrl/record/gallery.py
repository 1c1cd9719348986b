"""Pictures of tasks: what an expert's episode looks like, to people and to a policy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ba_torchrl import make
from ba_torchrl.envs import keys


def expert_strip(task: str, seed: int, pictures: int = 4) -> tuple[list[np.ndarray], np.ndarray]:
    """Play one episode with the expert.

    Args:
        task: id of the task.
        seed: of the episode.
        pictures: how many to take, evenly spread from the first scene to the last.

    Returns:
        Pictures [H, W, 3] uint8, and the first image that a policy sees, [H, W] metres.
    """
    env = make(task, expert=True, seed=seed)
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
    return [frames[i] for i in chosen], first


def contact_sheet(
    rows: Sequence[tuple[str, list[np.ndarray], np.ndarray]], path: str | Path
) -> Path:
    """Write a sheet with one row per task: the policy's first image, then the expert's episode.

    Args:
        rows: name, pictures and image of each task, as `expert_strip` returns them.
        path: the PNG to write.
    """
    columns = 1 + max(len(pictures) for _, pictures, _ in rows)
    figure = Figure(figsize=(2.6 * columns, 2.35 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, (name, pictures, image) in zip(axes, rows, strict=True):
        for axis in line:
            axis.set_axis_off()
        line[0].imshow(image, cmap="gray")
        line[0].set_title(name, fontsize=11, loc="left")
        for axis, picture in zip(line[1:], pictures, strict=False):
            axis.imshow(picture)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=70)
    return path
