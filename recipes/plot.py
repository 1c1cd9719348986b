"""Draw the learning curves of several runs in one picture.

python recipes/plot.py 'runs=[runs/first,runs/second]' path=curves.png
"""

import csv

import numpy as np

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Folders, PluginSettings, PngFile
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.logging import read_scalars
from ba_torchrl.record.plots import Learning, plot_panels
from ba_torchrl.training.checkpoint import read_config

RATE, ERROR = "eval/success_rate", "eval/standard_error"


class Settings(PluginSettings):
    """Settings of this command."""

    runs: Folders
    """Run folders."""
    path: PngFile = "curves.png"
    """The picture."""
    title: str = ""
    """Of the picture."""


def main(settings: Settings) -> None:
    """Plot the success rate of the greedy policies against the updates."""
    curves = {}
    for run in settings.runs:
        config = read_config(run, device="cpu")  # that of the run may not be here
        name = f"{config.label}, {config.task.split('/')[-1]}, seed {config.seed}"
        curves[name] = _curve(run)
    panels = {settings.title: {name: Learning(curve) for name, curve in curves.items()}}
    ylabel = "success rate of the greedy policy"
    try:
        plot_panels(panels, [settings.path], names=list(curves), ylabel=ylabel, panel_in=(5, 3.6))
    except ValueError as error:  # such as a title with an incomplete formula
        raise ConfigError(f"cannot draw the curves: {error}") from None
    print(settings.path)


def _curve(run: str) -> tuple[np.ndarray, ...]:
    """Return updates, success rate, and the rate minus and plus its standard error.

    Raises:
        ConfigError: the run has no evaluation, or its scalars cannot be read.
    """
    try:
        scalars = read_scalars(run)
    except (OSError, ValueError, ArithmeticError, csv.Error) as error:
        raise ConfigError(f"cannot read the scalars of {run}: {error}") from None
    if RATE not in scalars or ERROR not in scalars:
        raise ConfigError(f"{run} has no evaluation yet")
    rate, error = scalars[RATE], scalars[ERROR]
    if not np.array_equal(rate.steps, error.steps):
        raise ConfigError(
            f"the scalars of {run} are incomplete: {RATE} and {ERROR} differ in steps"
        )
    return rate.steps, rate.values, rate.values - error.values, rate.values + error.values


COMMAND = Command(main, Settings, positional="runs")

if __name__ == "__main__":
    COMMAND.run()
