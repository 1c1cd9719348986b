"""Figures of learning curves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ba_torchrl.errors import MissingPackageError, install_command
from ba_torchrl.record.logging import read_scalars

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import ArrayLike

    Curve = Sequence[ArrayLike]

# Distinguishable by colour-blind readers (Okabe and Ito), in order of decreasing contrast.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_STYLES = ("-", "--", ":", "-.")
_MANY_POINTS = 25
LEAST_WIDTH_IN = 5.0
"""Least width of a figure, for the legend."""
MOST_LEGEND_ROWS = 5
"""Largest number of rows of a legend below the panels; a longer one is at their right."""


def plot_learning_curve(
    curves: Mapping[str, Curve] | str | Path,
    path: str | Path,
    *,
    title: str = "",
    xlabel: str = "updates",
    ylabel: str = "success rate",
    ylim: tuple[float, float] | None = (0.0, 1.0),
) -> Path:
    """Plot curves into a PNG, with optional error bands, and return its path.

    Args:
        curves: by name, (x, y) or (x, y, low, high), each [n]; low and high bound the band, for
            example mean minus and plus standard error. Or the ``scalars.csv`` of a run, of which
            the success rates are plotted.
        ylim: limits of the y axis; None for automatic limits.

    Raises:
        ImportError: matplotlib is missing.
        ValueError: there is no curve, or the parts of one differ in length.
    """
    figure = _figure((7, 4.5))
    if isinstance(curves, str | Path):
        scalars = read_scalars(curves)
        curves = {name: scalars[name] for name in scalars if name.endswith("success_rate")}
    if not curves:
        raise ValueError("there is no curve to draw")
    axes = figure.add_subplot()
    for number, (name, curve) in enumerate(curves.items()):
        _draw(axes, number, name, curve)
    axes.set(title=title, xlabel=xlabel, ylabel=ylabel)
    _style_axes(axes, ylim)
    axes.legend(frameon=False, loc="best")
    return _save(figure, path)


def plot_panels(
    panels: Mapping[str, Mapping[str, Curve]],
    path: str | Path,
    *,
    names: Sequence[str],
    xlabel: str = "updates",
    ylabel: str = "success rate",
    ylim: tuple[float, float] | None = (0.0, 1.0),
    columns: int | None = None,
) -> Path:
    """Plot curves into a grid of panels, as in the paper's figures 18 to 22, and return the PNG.

    Args:
        panels: curves as for `plot_learning_curve`, by title.
        names: names of all curves, in the order of colours; a name has the same colour in all
            panels.
        columns: largest number of panels in a row; None for three to five, with the fewest empty
            cells.

    Raises:
        ImportError: matplotlib is missing.
        ValueError: there is no panel, a name is not in ``names``, or the parts of a curve differ
            in length.
    """
    if not panels:
        raise ValueError("there is no panel to draw")
    columns = columns or min((5, 4, 3), key=lambda n: -len(panels) % n)
    columns = min(columns, len(panels))
    rows = math.ceil(len(panels) / columns)
    width_in = max(3.1 * columns + 0.6, LEAST_WIDTH_IN)
    entry_in = 0.6 + 0.09 * max(map(len, names), default=0)
    entries = max(int(width_in / entry_in), 1)  # in a row of the legend
    legend_rows = math.ceil(len(names) / entries)
    place, height_in = "outside lower center", 2.6 * rows + 0.6 + 0.25 * legend_rows
    if legend_rows > MOST_LEGEND_ROWS:
        place, width_in, entries = "outside right upper", width_in + entry_in + 0.4, 1
        height_in = max(2.6 * rows + 0.6, 0.25 * len(names) + 0.3)
    figure = _figure((width_in, height_in))
    grid = figure.subplots(rows, columns, squeeze=False, sharey=ylim is not None)
    shown: dict[str, Line2D] = {}
    for axes, (title, curves) in zip(grid.flat, panels.items(), strict=False):
        for name, curve in curves.items():
            shown[name] = _draw(axes, list(names).index(name), name, curve)
        axes.set_title(title, fontsize=10)
        _style_axes(axes, ylim)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    for column in range(columns):
        lowest = (len(panels) - 1 - column) // columns
        grid[lowest, column].set_xlabel(xlabel)
    for axes in grid[:, 0]:
        axes.set_ylabel(ylabel)
    labels = [name for name in names if name in shown]
    figure.legend(
        [shown[name] for name in labels],
        labels,
        loc=place,
        ncols=min(entries, max(len(labels), 1)),
        frameon=False,
    )
    return _save(figure, path)


def _figure(size_in: tuple[float, float]) -> Figure:
    try:
        from matplotlib.figure import Figure  # no pyplot: it holds figures in a global list
    except ImportError as error:
        fix = f"drawing curves needs {install_command('matplotlib')}"
        raise MissingPackageError(fix) from error
    return Figure(figsize=size_in, dpi=150, layout="constrained")


def _style_axes(axes: Axes, ylim: tuple[float, float] | None) -> None:
    if ylim is not None:
        margin = 0.02 * (ylim[1] - ylim[0])  # keeps lines at the limits visible
        axes.set_ylim(ylim[0] - margin, ylim[1] + margin)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def _save(figure: Figure, path: str | Path) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png")
    return path


def _draw(axes: Axes, number: int, name: str, curve: Curve) -> Line2D:
    parts = [np.asarray(part, dtype=float) for part in curve]
    if len(parts) not in (2, 4) or any(part.shape != (parts[0].size,) for part in parts):
        raise ValueError(
            f"curve {name!r} is not x, y or x, y, low, high of one length: "
            f"got shapes {[list(part.shape) for part in parts]}"
        )
    x, y, *band = parts
    color = _COLORS[number % len(_COLORS)]
    style = _STYLES[number // len(_COLORS) % len(_STYLES)]
    marker = "o" if x.size <= _MANY_POINTS else None
    (line,) = axes.plot(
        x, y, color=color, linestyle=style, marker=marker, markersize=3.5, label=name
    )
    if band:
        axes.fill_between(x, *band, color=color, alpha=0.2, linewidth=0)
    return line
