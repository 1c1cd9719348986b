"""Run a learning script of another library as it is, and print how many episodes reach the goal.

    python recipes/stock_scripts.py BulletArm/CloseLoopBlockReaching-StateDense-v0 --log sac.jsonl \
        -- sac/sac.py env.name=ENV logger.backend= collector.total_frames=8000

`ENV` stands for the id among the script's arguments. The success flags of the last 20 episodes are
counted, in training and in the script's own evaluation; the script does not read them. The table
has the minutes that passed and those of one core, which are fewer on a busy machine.

docs/torchrl.md has the command for TorchRL's SAC and the success rates. The other scripts had these
settings:

    TD3, TorchRL      as SAC, without optim.alpha_init
    CrossQ, TorchRL   as SAC, without optim.lr and optim.target_update_polyak, with
                      env.library=gymnasium 'network.critic_hidden_sizes=[256,256]'
                      network.warmup_steps=1000
    PPO, TorchRL      env.env_name=ENV logger.backend= optim.device=cpu optim.lr=1e-3
                      loss.gamma=0.95 collector.frames_per_batch=1024 collector.total_frames=40960
    SAC, CleanRL      --gamma 0.95 --policy-lr 1e-3 --tau 0.02 --batch-size 128
                      --learning-starts 500
    SAC, Stable-Baselines3
                      gamma=0.95 learning_rate=1e-3 tau=0.02 ent_coef="auto_0.1" batch_size=128
                      learning_starts=500
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import runpy
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec

import ba_torchrl  # noqa: F401 -- registers the ids

LOG = "STOCK_SCRIPTS_LOG"
"""Environment variable: file to which the environments of the script write their episodes."""
WINDOW = 20
"""Number of episodes whose success is averaged."""


class CountSuccess(gymnasium.Wrapper):
    """Writes the success flag of every episode to the file `LOG`."""

    number = itertools.count()

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.name, self.steps = f"{os.getpid()}-{next(self.number)}", 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and write a line if the episode ends."""
        result = self.env.step(action)
        self.steps += 1
        if result[2] or result[3]:
            line = {"env": self.name, "steps": self.steps, "success": bool(result[4]["success"])}
            line |= {"wall_s": time.time(), "cpu_s": time.process_time()}
            with Path(os.environ[LOG]).open("a") as file:
                file.write(json.dumps(line) + "\n")
        return result


def register(name: str) -> str:
    """Register an id whose environments count their successes, and return it."""
    spec, counted = gymnasium.spec(name), f"Counted/{name.rpartition('/')[2]}"
    # this file under its own name, since the script becomes the main module
    counter = WrapperSpec("CountSuccess", f"{Path(__file__).stem}:CountSuccess", {})
    fields = {field.name for field in dataclasses.fields(spec) if field.init} - {"id"}
    values = {field: getattr(spec, field) for field in fields}
    values["additional_wrappers"] = (*spec.additional_wrappers, counter)
    gymnasium.register(counted, **values)
    return counted


def rates(lines: list[dict[str, Any]], start_s: float) -> str:
    """Return a table of success over time.

    Training is the environment that took the most steps, evaluation are all others.
    """
    trained = max(lines, key=lambda line: line["steps"], default={"env": None})["env"]
    titles = ("steps", "success in training", "in evaluation", "minutes", "of one core")
    rows = [f"| {' | '.join(titles)} |", f"|{'---|' * len(titles)}"]
    training, evaluation = [], []
    for line in lines:
        is_training = line["env"] == trained
        (training if is_training else evaluation).append(line["success"])
        if is_training and not len(training) % WINDOW:
            cells = [line["steps"], *map(_share, (training, evaluation))]
            cells += [f"{(line['wall_s'] - start_s) / 60:.1f}", f"{line['cpu_s'] / 60:.1f}"]
            rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(rows)


def _share(successes: list[bool]) -> str:
    last = successes[-WINDOW:]
    return f"{sum(last) / len(last):.2f} of {len(last)}" if last else ""


def main() -> None:
    """Run the script in this process and print the table, also if it ends early."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("env", help="id of the task")
    parser.add_argument("--log", type=Path, required=True, help="new file for the episodes")
    parser.add_argument("script", nargs="+", help="path and arguments, after --")
    options = parser.parse_args()
    log, script = options.log.resolve(), options.script
    log.touch(exist_ok=False)
    os.environ[LOG] = str(log)
    name = register(options.env)
    sys.argv = [script[0], *(word.replace("ENV", name) for word in script[1:])]
    sys.path.insert(0, str(Path(script[0]).parent))
    start_s = time.time()
    try:
        runpy.run_path(script[0], run_name="__main__")
    finally:
        print(rates([json.loads(line) for line in log.read_text().splitlines()], start_s))


if __name__ == "__main__":
    main()
