"""Learning curves as pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ba_torchrl.record.logging import read_scalars

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    Curve = Sequence[ArrayLike]

# Told apart by colour-blind readers too (Okabe and Ito), in an order of decreasing contrast.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_STYLES = ("-", "--", ":", "-.")
_MANY_POINTS = 25


def plot_learning_curve(
    curves: Mapping[str, Curve] | str | Path,
    path: str | Path,
    *,
    title: str = "",
    xlabel: str = "updates",
    ylabel: str = "success rate",
    ylim: tuple[float, float] | None = (0.0, 1.0),
) -> Path:
    """Draw curves into a PNG, each with a band if it has one.

    Args:
        curves: by name, x and y or x, y, low and high, each [n]; low and high bound the band,
            such as mean minus and plus standard error. Or the ``scalars.csv`` of a run, whose
            success rates are drawn.
        path: of the PNG; its folder is made if it does not exist.
        title: above the axes.
        xlabel: below them.
        ylabel: at their left.
        ylim: least and greatest y; None fits the curves.

    Returns:
        The path.

    Raises:
        ImportError: matplotlib is missing.
        ValueError: there is no curve, or the parts of one differ in length.
    """
    try:
        from matplotlib.figure import Figure  # no pyplot: it keeps figures in a global list
    except ImportError as error:
        raise ImportError("drawing curves needs pip install 'ba-torchrl[recipes]'") from error
    if isinstance(curves, str | Path):
        scalars = read_scalars(curves)
        curves = {name: scalars[name] for name in scalars if name.endswith("success_rate")}
    if not curves:
        raise ValueError("there is no curve to draw")
    figure = Figure(figsize=(7, 4.5), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    for number, (name, curve) in enumerate(curves.items()):
        _draw(axes, number, name, curve)
    axes.set(title=title, xlabel=xlabel, ylabel=ylabel)
    if ylim is not None:
        margin = 0.02 * (ylim[1] - ylim[0])  # lines along the edges stay visible
        axes.set_ylim(ylim[0] - margin, ylim[1] + margin)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="best")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png")
    return path


def _draw(axes: Axes, number: int, name: str, curve: Curve) -> None:
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
    axes.plot(x, y, color=color, linestyle=style, marker=marker, markersize=3.5, label=name)
    if band:
        axes.fill_between(x, *band, color=color, alpha=0.2, linewidth=0)
