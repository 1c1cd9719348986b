"""Write the policy of a run into one file, with a card of its success.

ba-torchrl export runs/my-run     # writes close_loop_block_picking.safetensors
ba-torchrl export runs/my-run path=my-policy.safetensors
"""

from __future__ import annotations

import shlex
from pathlib import Path

from pydantic import Field

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import NewPath, Text, check_new, check_writable_file
from ba_torchrl.commands import evaluate
from ba_torchrl.core.config import LocalPath


class Settings(evaluate.EpisodeSettings):
    """Settings of this command: those of the evaluation that the card reports, and the file."""

    policy: LocalPath
    """A run folder, one of the checkpoints in it, or a .safetensors file."""
    path: NewPath | None = None
    """New file; null for one named after the task."""
    device: Text = "cpu"
    """Where the policy is computed."""
    episodes: int = Field(default=500, ge=1)
    """Episodes of the test on the policy's card."""


def main(settings: Settings) -> None:
    """Evaluate the policy, and write it with its card."""
    from ba_torchrl import load_policy
    from ba_torchrl.training.policy import TENSORS, round_weights, save_policy

    policy = load_policy(settings.policy, settings.which, settings.device)
    path = Path(settings.path or f"{policy.task.replace('/', '_')}{TENSORS}")
    check_new(path)
    check_writable_file(path, suffixes=(TENSORS,))
    round_weights(policy)
    card = save_policy(policy, path, evaluate.play(policy, settings))
    print(evaluate.success_text(card.success_rate, card.episodes, card.task))
    print(f"  policy  {path}, {path.stat().st_size / 1e6:.2f} MB")
    named = f"policy={path.name}"  # the card may be moved with its file
    words = [f"policy={path}" if word == named else word for word in shlex.split(card.evaluate)]
    print(f"  check   {shlex.join(words)}")


COMMAND = Command(main, Settings, positional="policy")
