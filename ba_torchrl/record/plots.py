"""Figures of learning curves."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ba_torchrl.core.errors import MissingPackageError, install_command
from ba_torchrl.core.files import replaced
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
_MARKERS = "osD^vPX*<>"
_MOST_MARKERS = 25
_LABEL_PT = 7
_LABEL_WIDTH = 24
"""Characters in a line of a label beside a panel."""


class Learning(NamedTuple):
    """A method in a panel."""

    curve: Curve
    """As for `plot_learning_curve`."""
    runs: Sequence[Curve] = ()
    """(x, y) of each run, drawn as thin lines."""
    demonstration_steps: float = 0.0
    """Length of a dotted line to the left of 0."""


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
    panels: Mapping[str, Mapping[str, Learning]],
    paths: Sequence[str | Path],
    *,
    names: Sequence[str],
    xlabel: str = "updates",
    ylabel: str = "success rate",
) -> None:
    """Plot rates into a grid of panels, as in the paper's figures 18 to 22.

    The labels of the curves are at the right of each panel, beside their last points.

    Args:
        panels: methods by name, by title.
        paths: of the figure in several formats, such as ``.svg`` and ``.pdf``.
        names: names of all curves, in the order of colours and markers; a name has the same ones in
            all panels.

    Raises:
        ImportError: matplotlib is missing.
        ValueError: there is no panel, a name is not in ``names``, or the parts of a curve differ
            in length.
    """
    if not panels:
        raise ValueError("there is no panel to draw")
    columns = min(min((4, 3), key=lambda n: -len(panels) % n), len(panels))
    rows = math.ceil(len(panels) / columns)
    labels = {name: textwrap.wrap(name, _LABEL_WIDTH) for name in names}
    gap_in = 1.3 * _LABEL_PT / 72 * max(map(len, labels.values()), default=1)
    height_in = max(1.8, gap_in * max(map(len, panels.values())))
    longest = max((len(line) for lines in labels.values() for line in lines), default=0)
    figure = _figure((columns * (2.5 + 0.6 * _LABEL_PT / 72 * longest), rows * (height_in + 0.7)))
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, (title, curves) in zip(grid.flat, panels.items(), strict=False):
        ends = []
        for name, method in curves.items():
            line = _draw(axes, list(names).index(name), name, method.curve)
            thin = {"color": line.get_color(), "linewidth": 0.5, "alpha": 0.6}
            for run in method.runs:
                axes.plot(*run, **thin)
            if method.demonstration_steps and line.get_xdata().size:
                (x, y), *_ = line.get_xydata()
                before = [-method.demonstration_steps, x], [y, y]
                axes.plot(*before, color=line.get_color(), linewidth=1.0, linestyle=":")
            label = "\n".join(labels[name])
            ends += [(x, y, line, label) for x, y in line.get_xydata()[-1:]]
        _label(axes, ends, gap_in / height_in)
        axes.set_title(title, fontsize=10)
        before = max((method.demonstration_steps for method in curves.values()), default=0)
        axes.set_xlim(left=-1.05 * before)
        if before:
            axes.axvspan(-1.05 * before, 0, color="0.95", zorder=0)
            axes.xaxis.set_major_formatter(lambda x, _: f"{abs(x):g}")
        _style_axes(axes, (0.0, 1.0))
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    demonstrated = any(each.demonstration_steps for of in panels.values() for each in of.values())
    xlabel += "; dotted, left of 0: steps of demonstrations" if demonstrated else ""
    figure.supxlabel(xlabel, fontsize=10)
    figure.supylabel(ylabel, fontsize=10)
    for path in paths:
        _save(figure, path)


def _label(axes: Axes, ends: Sequence[tuple[float, float, Line2D, str]], gap: float) -> None:
    """Write the names of curves at the right of a panel, without overlap.

    Args:
        axes: the panel, with limits of 0 and 1.
        ends: last point, line and label of each curve.
        gap: least distance of two labels in the height of the panel.
    """
    ends = sorted(ends, key=lambda end: end[1])
    steps = gap * np.arange(len(ends))
    heights = np.maximum.accumulate([end[1] for end in ends] - steps) + steps
    heights = np.minimum(heights, 1 - steps[::-1])
    for (x, y, line, label), height in zip(ends, heights, strict=True):
        color, beside = line.get_color(), axes.get_yaxis_transform()  # x in widths of the panel
        mark = {"marker": line.get_marker(), "color": color, "markersize": 3.5}
        axes.plot(1.05, height, **mark, transform=beside, clip_on=False)
        leader = {"arrowstyle": "-", "color": color, "lw": 0.5, "shrinkA": 0}
        axes.annotate("", (x, y), (1.05, height), textcoords=beside, arrowprops=leader)
        axes.text(1.09, height, label, transform=beside, va="center", fontsize=_LABEL_PT)


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
    from matplotlib import rc_context

    metadata = {"Date": None} if path.suffix == ".svg" else None
    # the same file for the same curves
    with rc_context({"svg.hashsalt": path.stem}), replaced(path) as scratch:
        figure.savefig(scratch, metadata=metadata)
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
    (line,) = axes.plot(
        x,
        y,
        color=color,
        linestyle=style,
        marker=_MARKERS[number % len(_MARKERS)],
        markersize=3.5,
        markevery=math.ceil(x.size / _MOST_MARKERS),
        label=name,
    )
    if band:
        axes.fill_between(x, *band, color=color, alpha=0.2, linewidth=0)
    return line
