"""Soak test: thousands of steps of every task; a table of faults, memory and clients left open.

python recipes/soak.py                                        # the same command continues it
python recipes/soak.py steps=100 long_steps=500 folder=/tmp/soak
python recipes/soak.py tasks=[open_loop/bin_packing] steps=5000
"""

import sys
from pathlib import Path

import hydra
from omegaconf import DictConfig

from ba_torchrl import list_tasks
from ba_torchrl.envs.settings import resolve_env
from ba_torchrl.plugins import load_plugins
from ba_torchrl.profiling.soak import TABLE_FILE, SoakJob, run_soak
from ba_torchrl.record.logging import limit_library_logs
from ba_torchrl.training.command_line import (
    check_counts,
    check_known,
    check_lists,
    check_seed,
    check_tasks,
    check_texts,
    check_writable_file,
    env_of,
    plain_errors,
    register_schemas,
)

register_schemas()


@hydra.main(config_path="../configs", config_name="soak", version_base="1.3")
@plain_errors
def main(settings: DictConfig) -> None:
    """Run the tasks without figures, and print the table."""
    limit_library_logs()
    check_known(settings)
    load_plugins(settings.plugins)
    check_lists(settings, "long_tasks")
    check_tasks(settings)
    check_texts(settings, "folder")
    check_counts(settings, "steps", "long_steps", least=10)
    check_seed(settings)
    env = env_of(settings, seed="seed", expert="steps: every other episode is the expert's")
    tasks = list(settings.tasks or list_tasks())
    for task in tasks:
        resolve_env(task, env)  # raises with the known names
    folder = Path(settings.folder)
    check_writable_file(folder / TABLE_FILE)
    jobs = [
        SoakJob(
            task=task,
            steps=settings.long_steps if task in settings.long_tasks else settings.steps,
            seed=settings.seed,
            env=env,
            plugins=settings.plugins,
        )
        for task in tasks
    ]
    failures = run_soak(jobs, folder)
    table = folder / TABLE_FILE
    if table.exists():
        print(f"\n{table.read_text()}")
    for task, failure in failures.items():
        print(f"{task}: {failure}")
    if failures:
        sys.exit(1)


if __name__ == "__main__":
    main()
