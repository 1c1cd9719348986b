"""Train a policy.

ba-torchrl train --config-name quickstart
ba-torchrl train task=close_loop/block_picking algorithm=sacfd rotation=none network=equi
ba-torchrl train run_dir=runs/mine resume=true
ba-torchrl train 'plugins=[my_tasks]' task=mine/push_far
ba-torchrl train num_envs=8 collector=multi_async collector.workers=4
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

from ba_torchrl.cli.command import Arguments, Command
from ba_torchrl.cli.types import check_writable_folder
from ba_torchrl.core.config import expanded
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.record.results import (
    CITABLE_EPISODES,
    CONFIG_FILE,
    NON_LEARNING_FIELDS,
    RESULT_FILE,
)
from ba_torchrl.training.config import ExperimentConfig

logger = logging.getLogger(__name__)


def parse(values: dict[str, Any], arguments: Arguments) -> ExperimentConfig:
    """Return the run; that of an existing folder if the command line only resumes it."""
    if values["resume"] is True:
        from ba_torchrl.training.checkpoint import read_config  # imports torch, which takes seconds

        folder = expanded(values["run_dir"])
        exists = (Path(folder) / CONFIG_FILE).exists()
        is_folder_alone = arguments.config_name is None and not arguments.presets
        if is_folder_alone and arguments.names <= NON_LEARNING_FIELDS:
            if "run_dir" not in arguments.names:
                raise ConfigError("resume=true needs run_dir=FOLDER, the run to continue")
            if not exists:
                raise ConfigError(f"there is no run in {folder} to resume")
            return read_config(folder, **{name: values[name] for name in arguments.names})
        if not exists:
            logger.warning("there is no run in %s to resume: a new one starts", folder)
    return ExperimentConfig.parse(values, given=arguments.names)


def main(config: ExperimentConfig) -> None:
    """Run or resume the experiment."""
    from ba_torchrl.training.experiment import Experiment
    from ba_torchrl.training.interruption import RunStopped

    check_writable_folder(config.run_dir)
    try:
        result = Experiment(config).run()
    except RunStopped as stopped:
        print(stopped, file=sys.stderr)
        raise
    last, best = result.last, result.best
    remark = "" if last.is_citable else f", fewer than the {CITABLE_EPISODES} of a number to cite"
    print(f"success_rate {last.success_rate:.2f} over {last.episodes} episodes{remark}")
    print(
        f"  last policy, of update {last.updates}; {last.mean_length:.1f} steps per episode; "
        f"{result.seconds / 60:.1f} minutes"
    )
    print(f"  best        {best.success_rate:.2f}, the checkpoint of update {best.updates}")
    for name in ("curve", "video", "checkpoint"):
        if name in result.files:
            print(f"  {name:<10}  {config.folder / result.files[name]}")
    print(f"  result      {config.folder / RESULT_FILE}")
    print("  to use it in Python:")
    print(f"    import {', '.join(('ba_torchrl', *config.plugins))}")
    print(f'    policy = ba_torchrl.load_policy({config.run_dir!r}, which="latest")  # or "best"')
    print("    env = policy.make_env()")
    print("    env.rollout(env.max_steps, policy)")


COMMAND = Command(main, ExperimentConfig, config="train", variants="quickstart*", parse=parse)
