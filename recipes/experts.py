"""Measure the experts: success rate and length of random episodes, as a table in Markdown.

python recipes/experts.py                                 # every task, kuka, with and without yaw
python recipes/experts.py robots=[panda,ur5] episodes=50 tasks=[close_loop/block_picking]
"""

from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig
from tqdm import tqdm

from ba_torchrl import list_tasks
from ba_torchrl.data.demos import expert_scores
from ba_torchrl.envs.vector.make import MAX_ENVS
from ba_torchrl.errors import ConfigError
from ba_torchrl.plugins import load_plugins
from ba_torchrl.record.logging import limit_library_logs
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.command_line import (
    check_counts,
    check_flags,
    check_known,
    check_lists,
    check_seed,
    check_tasks,
    check_texts,
    check_writable_file,
    mapping_of,
    plain_errors,
    register_schemas,
)

SET_FOR_ALL = {
    **{name: f", and set {name}" for name in ("seed", "num_envs", "parallel")},
    "robot": ", and set robots",
    "expert": "; all episodes are the expert's",
}
"""What the settings of the recipe determine in every column, and what to do instead."""

register_schemas()


@hydra.main(config_path="../configs", config_name="experts", version_base="1.3")
@plain_errors
def main(settings: DictConfig) -> None:
    """Play the experts' episodes and print their success and length."""
    limit_library_logs()
    check_known(settings)
    load_plugins(settings.plugins)
    check_lists(settings, "robots", least=1)
    check_tasks(settings)
    check_texts(settings, "path", optional=True)
    check_counts(settings, "episodes")
    check_counts(settings, "num_envs", most=MAX_ENVS)
    check_flags(settings, "parallel", optional=True)
    check_seed(settings)
    if settings.path is not None:
        check_writable_file(settings.path)
    for robot in settings.robots:
        _ = ROBOTS[robot]  # raises with the known names
    variants = mapping_of(settings, "variants")
    _check_variants(variants)
    tables = []
    for table, columns in variants.items():
        tasks = [
            task for task in settings.tasks or list_tasks() if _table_of(task, variants) == table
        ]
        if not tasks:
            continue
        lines = [
            f"| task | robot | {' | '.join(columns)} |",
            f"|---|---|{'---|' * len(columns)}",
        ]
        cells = [(task, robot) for task in tasks for robot in settings.robots]
        for task, robot in tqdm(cells, unit="row"):
            row = [_cell(task, settings, {**env, "robot": robot}) for env in columns.values()]
            lines.append(f"| `{task}` | {robot} | {' | '.join(row)} |")
            tqdm.write(lines[-1])
        tables.append("\n".join(lines))
    text = "\n\n".join(tables)
    print(f"\n{text}\n\n{settings.episodes} episodes each, seed {settings.seed}")
    if settings.path is not None:
        Path(settings.path).write_text(text + "\n")


def _check_variants(variants: dict[str, Any]) -> None:
    """Check that every table is a group of columns, and every column a group of fields."""
    for table, columns in variants.items():
        if not isinstance(columns, dict) or not columns:
            raise ConfigError(f"variants.{table}: must be a group of columns, got {columns!r}")
        for column, env in columns.items():
            where = f"variants.{table}.{column}"
            if not isinstance(env, dict):
                raise ConfigError(f"{where}: must be a group of settings, got {env!r}")
            for name, instead in SET_FOR_ALL.items():
                if name in env:
                    raise ConfigError(f"{where}.{name}: leave it out{instead}")


def _table_of(task: str, variants: dict[str, Any]) -> str:
    """Return the key of a task's table: its group, the part of its id before the slash, or control.

    Args:
        task: id of the task.
        variants: columns of each table.
    """
    group = task.split("/")[0]
    return group if group in variants else TASKS[task].control


def _cell(task: str, settings: DictConfig, env: dict[str, Any]) -> str:
    try:
        scores = expert_scores(
            task,
            settings.episodes,
            seed=settings.seed,
            num_envs=settings.num_envs,
            parallel=settings.parallel,
            **env,
        )
    except ConfigError as error:
        return f"not possible: {error}"
    if not scores.success_rate:
        return "0.000"
    lengths = f"{scores.mean_length:.1f} steps, median {scores.median_length:g}"
    return f"{scores.success_rate:.3f}, {lengths}"


if __name__ == "__main__":
    main()
