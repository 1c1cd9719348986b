"""Figures of learning curves and of failures."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib import rc_context, rcdefaults, rcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure  # no pyplot: it holds figures in a global list
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from ba_torchrl.core.files import atomic_file
from ba_torchrl.record.summary import printable

if TYPE_CHECKING:
    from ba_torchrl.testing.diagnosis import Picture

# Distinguishable by colour-blind readers (Okabe and Ito), in order of decreasing contrast.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_STYLES = ("-", "--", ":", "-.")
_MARKERS = "osD^vPX*<>"
_MOST_MARKERS = 25
_LIGHT = ("#56B4E9", "#E69F00", "#009E73")
"""Of lines on a dark image."""
_LABEL_PT = 7
_LABEL_WIDTH = 24
"""Characters in a line of a label beside a panel."""


class Learning(NamedTuple):
    """A method in a panel."""

    curve: Sequence[ArrayLike]
    """(x, y), or (x, y, low, high) with the limits of a band, [n] each."""
    runs: Sequence[Sequence[ArrayLike]] = ()
    """(x, y) of each run, drawn as thin lines."""
    demonstration_steps: float = 0.0
    """Length of a dotted line to the left of 0."""


@contextmanager
def own_style() -> Iterator[None]:
    """Context, also a decorator, of every figure: the user's matplotlibrc has no effect in it, and
    a dollar sign is one, not the begin of a formula."""
    with rc_context():
        rcdefaults()
        rcParams["text.parse_math"] = False
        rcParams["pdf.fonttype"] = 42  # TrueType: publishers refuse Matplotlib's Type 3 fonts
        yield


@own_style()
def plot_panels(
    panels: Mapping[str, Mapping[str, Learning]],
    paths: Sequence[str | Path],
    *,
    names: Sequence[str],
    xlabel: str = "updates",
    ylabel: str = "success rate",
    panel_in: tuple[float, float] = (2.5, 1.8),
    columns: int = 4,
) -> None:
    """Plot rates into a grid of panels, as in the paper's figures 18 to 22.

    The labels of the curves are at the right of each panel, beside their last points.

    Args:
        panels: methods by name, by title.
        paths: of the figure in several formats, such as ``.svg`` and ``.pdf``.
        names: names of all curves, in the order of colours and markers; a name has the same ones in
            all panels.
        panel_in: width and least height of a panel.
        columns: most panels in a row; of four, three where they leave fewer places empty.
    """
    columns = min(columns, min((4, 3), key=lambda n: -len(panels) % n), len(panels))
    rows = math.ceil(len(panels) / columns)
    labels = {name: textwrap.wrap(printable(name), _LABEL_WIDTH) for name in names}
    gap_in = 1.3 * _LABEL_PT / 72 * max(map(len, labels.values()), default=1)
    height_in = max(panel_in[1], gap_in * max(map(len, panels.values())))
    longest = max((len(line) for lines in labels.values() for line in lines), default=0)
    width_in = panel_in[0] + 0.6 * _LABEL_PT / 72 * longest
    demonstrated = any(each.demonstration_steps for of in panels.values() for each in of.values())
    xlabel += "\ndotted, left of 0: steps of demonstrations" if demonstrated else ""
    size_in = columns * width_in, rows * (height_in + 0.75) + (0.2 if demonstrated else 0.0)
    figure = Figure(figsize=size_in, dpi=150, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, (title, curves) in zip(grid.flat, panels.items(), strict=False):
        ends = []
        for name, method in curves.items():
            line = _draw(axes, list(names).index(name), method)
            label = "\n".join(labels[name])
            ends += [(x, y, line, label) for x, y in line.get_xydata()[-1:]]
        _label(axes, ends, gap_in / height_in)
        axes.set_title(printable(title), fontsize=10)
        before = max((method.demonstration_steps for method in curves.values()), default=0)
        axes.set_xlim(left=-1.05 * before)
        if before:
            axes.axvspan(-1.05 * before, 0, color="0.95", zorder=0)
            axes.xaxis.set_major_formatter(lambda x, _: f"{abs(x):g}")
        axes.set_ylim(-0.02, 1.02)  # keeps lines at the limits visible
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    figure.supxlabel(xlabel, fontsize=10)
    figure.supylabel(ylabel, fontsize=10)
    for path in map(Path, paths):
        save(figure, path)


@own_style()
def plot_failure(picture: Picture, path: Path) -> None:
    """Draw the actions of policy and expert into the height image, beside a view of the scene.

    Each gripper is a line between its open fingers. In close loop, arrows lead from the tool to it.
    """
    figure = Figure(figsize=(9.5, 4.4), dpi=100, layout="constrained")
    above, view = figure.subplots(1, 2, width_ratios=(1, 1.1))
    above.imshow(
        picture.heights,
        cmap="gray",
        extent=(*picture.y_m, *reversed(picture.x_m)),  # rows follow x, columns y
    )
    if picture.tool is not None:
        _draw_gripper(above, picture, picture.tool, "tool", "0.75", 2.0)
    for number, (who, *pose, text) in enumerate(picture.arrows):
        style = _LIGHT[number], 4.0 - 1.2 * number
        _draw_gripper(above, picture, pose, f"{who}: {text}", *style)
        if picture.tool is not None:
            way = {"arrowstyle": "->", "color": style[0], "lw": style[1] / 2}
            above.annotate("", pose[1::-1], picture.tool[1::-1], arrowprops=way)
    above.set(xlim=picture.y_m, ylim=picture.x_m[::-1], xlabel="y (m)", ylabel="x (m)")
    above.tick_params(labelsize=_LABEL_PT)
    view.imshow(picture.rgb)
    view.set_axis_off()
    figure.legend(loc="outside lower center", fontsize=8)
    save(figure, path)


@own_style()
def save(figure: Figure, path: Path) -> None:
    """Write a figure, to the same file for the same content."""
    metadata = {"Date": None} if path.suffix == ".svg" else None
    rcParams["svg.hashsalt"] = path.stem
    with atomic_file(path) as scratch:
        figure.savefig(scratch, metadata=metadata)


def _draw_gripper(
    axes: Axes, picture: Picture, pose: Sequence[float], label: str, color: str, width: float
) -> None:
    """Draw the open fingers at a position and yaw, with a point between them."""
    x, y, yaw = pose
    half_x, half_y = (picture.finger_gap_m * part(yaw) for part in (math.cos, math.sin))
    marks = {"marker": "s", "markersize": 2 * width, "markevery": [0, 2]}
    along_y, along_x = (y - half_y, y, y + half_y), (x - half_x, x, x + half_x)
    axes.plot(along_y, along_x, color=color, linewidth=width, label=label, **marks)


def _draw(axes: Axes, number: int, method: Learning) -> Line2D:
    """Draw a method, whose colour and marker are those of a number; return the line of its mean."""
    x, y, *band = (np.asarray(part, dtype=float) for part in method.curve)
    color = _COLORS[number % len(_COLORS)]
    (line,) = axes.plot(
        x,
        y,
        color=color,
        linestyle=_STYLES[number // len(_COLORS) % len(_STYLES)],
        marker=_MARKERS[number % len(_MARKERS)],
        markersize=3.5,
        markevery=math.ceil(x.size / _MOST_MARKERS),
    )
    if band:
        axes.fill_between(x, *band, color=color, alpha=0.2, linewidth=0)
    for run in method.runs:
        axes.plot(*run, color=color, linewidth=0.5, alpha=0.6)
    if method.demonstration_steps and x.size:
        before = [-method.demonstration_steps, x[0]], [y[0], y[0]]
        axes.plot(*before, color=color, linewidth=1.0, linestyle=":")
    return line


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
