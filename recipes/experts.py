"""Measure the experts: success and length over random episodes, as a table in Markdown.

python recipes/experts.py                                 # every task, kuka, with and without yaw
python recipes/experts.py robots=[panda,ur5] episodes=50 tasks=[close_loop/block_picking]
"""

from pathlib import Path

import hydra
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from ba_torchrl import list_tasks
from ba_torchrl.data.demos import expert_scores
from ba_torchrl.record.logging import quiet_libraries
from ba_torchrl.training import hydra_schema

hydra_schema.register()


@hydra.main(config_path="../configs", config_name="experts", version_base="1.3")
def main(settings: DictConfig) -> None:
    """Let the experts play, and print how they did."""
    quiet_libraries()
    variants = OmegaConf.to_container(settings.variants, resolve=True)
    tasks = settings.tasks or list_tasks()
    lines = [
        f"| task | robot | {' | '.join(variants)} |",
        f"|---|---|{'---|' * len(variants)}",
    ]
    with tqdm(total=len(tasks) * len(settings.robots) * len(variants), unit="table cell") as bar:
        for task in tasks:
            for robot in settings.robots:
                cells = []
                for env in variants.values():
                    scores = expert_scores(
                        task,
                        settings.episodes,
                        seed=settings.seed,
                        num_envs=settings.num_envs,
                        parallel=settings.parallel,
                        **{**env, "robot": robot},
                    )
                    cells.append(f"{scores.success_rate:.3f}, {scores.mean_length:.1f} steps")
                    bar.update()
                lines.append(f"| `{task}` | {robot} | {' | '.join(cells)} |")
                tqdm.write(lines[-1])
    table = "\n".join(lines)
    print(f"\n{table}\n\n{settings.episodes} episodes each, seed {settings.seed}")
    if settings.path is not None:
        Path(settings.path).write_text(table + "\n")


if __name__ == "__main__":
    main()
