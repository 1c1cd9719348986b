"""Write the policy of a run into one file, or demonstrations in another library's format.

Beside a policy is a card of its success; beside demonstrations one of their task and their entries.

ba-torchrl export runs/my-run     # writes close_loop_block_picking.safetensors
ba-torchrl export runs/my-run path=my-policy.safetensors
ba-torchrl export demos=demos/picking format=lerobot path=exports/picking
ba-torchrl export demos=demos/picking format=minari path=exports/picking-v0    # an id of Minari
ba-torchrl export demos=demos/picking format=hdf5 path=exports/picking.hdf5    # robomimic
ba-torchrl export demos=demos/picking format=zarr path=exports/picking.zarr    # Diffusion Policy
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from pydantic import Field

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Text, check_writable_file, checked
from ba_torchrl.commands import evaluate
from ba_torchrl.core.config import changed
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.demonstrations.formats.base import FORMATS, card_file

_OF_POLICIES = ("which", "device", "episodes", "num_envs", "parallel")


class Settings(evaluate.EpisodeSettings):
    """Settings of this command: those of the evaluation that the card reports, and the file."""

    policy: Text | None = None
    """A run folder, one of the checkpoints in it, or a .safetensors file."""
    demos: Text | None = None
    """In place of a policy: a folder that collect wrote. Needs format and path only."""
    format: Annotated[Text, checked(FORMATS.__getitem__)] | None = None
    """Of demonstrations."""
    path: Annotated[Text, checked(check_writable_file)] | None = None
    """New file or folder. Null for a policy's file named after the task."""
    device: Text = "cpu"
    """Where the policy is computed."""
    episodes: int = Field(default=500, ge=1)
    """Episodes of the test on the policy's card."""


def main(settings: Settings) -> None:
    """Write a policy, or demonstrations."""
    from ba_torchrl.demonstrations.demo_files import read_demonstrations
    from ba_torchrl.demonstrations.exchange import export_demonstrations

    if (settings.policy is None) == (settings.demos is None):
        raise ConfigError("name either a policy or demos=FOLDER")
    if settings.policy is not None:
        _export_policy(settings.policy, settings)
        return
    if settings.format is None or settings.path is None:
        raise ConfigError(f"demos: set format ({', '.join(FORMATS)}) and path")
    for message in changed(settings, _OF_POLICIES, "on demonstrations; leave it out"):
        raise ConfigError(message)
    episodes, metadata = read_demonstrations(settings.demos)
    export_demonstrations(
        settings.path,
        episodes,
        format=settings.format,
        task=metadata["task"],
        env=metadata["env"],
        seed=metadata["seed"],
        source=metadata["source"],
        policy=metadata.get("policy", ""),
        expert_version=metadata["expert_version"],
    )
    path = Path(settings.path)
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    size = sum(file.stat().st_size for file in files) / 1e6
    print(f"{len(episodes)} episodes of {metadata['task']} in {path}, {size:.2f} MB")
    print(f"  card    {card_file(path)}")


def _export_policy(source: str, settings: Settings) -> None:
    """Evaluate the policy, and write it with its card."""
    from ba_torchrl import load_policy
    from ba_torchrl.training.policy import TENSORS, round_weights, save_policy

    if settings.format is not None:
        raise ConfigError("format: it is for demos; leave it out")
    policy = load_policy(source, settings.which, settings.device)
    path = Path(settings.path or f"{policy.task.replace('/', '_')}{TENSORS}")
    check_writable_file(path, suffixes=(TENSORS,))
    round_weights(policy)
    card = save_policy(policy, path, evaluate.play(policy, settings))
    low, high = card.interval
    print(
        f"success_rate {card.success_rate:.2f} (95 % interval {low:.2f} to {high:.2f}) over "
        f"{card.episodes} episodes of {card.task}"
    )
    print(f"  policy  {path}, {path.stat().st_size / 1e6:.2f} MB")
    named = f"policy={path.name}"  # the card may be moved with its file
    words = [f"policy={path}" if word == named else word for word in shlex.split(card.evaluate)]
    print(f"  check   {shlex.join(words)}")


COMMAND = Command(main, Settings, positional="policy")
