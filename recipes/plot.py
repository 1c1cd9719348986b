"""Draw the learning curves of several runs in one picture.

python recipes/plot.py runs=[runs/first,runs/second] path=curves.png
"""

import hydra
from omegaconf import DictConfig

from ba_torchrl.record.logging import read_scalars
from ba_torchrl.record.plots import plot_learning_curve
from ba_torchrl.training.checkpoint import read_config
from ba_torchrl.training.command_line import plain_errors


@hydra.main(config_path="../configs", config_name="plot", version_base="1.3")
@plain_errors
def main(settings: DictConfig) -> None:
    """Plot the success rate of the greedy policies against the updates."""
    curves = {}
    for run in settings.runs:
        config = read_config(run, device="cpu")  # that of the run may not be here
        scalars = read_scalars(run)
        rate, error = scalars["eval/success_rate"], scalars["eval/standard_error"]
        name = f"{config.label}, {config.task.split('/')[-1]}, seed {config.seed}"
        curves[name] = (
            rate.steps,
            rate.values,
            rate.values - error.values,
            rate.values + error.values,
        )
    path = plot_learning_curve(
        curves,
        settings.path,
        title=settings.title,
        xlabel="updates",
        ylabel="success rate of the greedy policy",
    )
    print(path)


if __name__ == "__main__":
    main()
