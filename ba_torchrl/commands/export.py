"""Write the policy of a run into one file, with the result of its test.

ba-torchrl export runs/my-run     # writes close_loop_block_picking.safetensors
ba-torchrl export runs/my-run path=my-policy.safetensors
"""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import NewPath, Text, check_new, check_writable_file
from ba_torchrl.commands import evaluate
from ba_torchrl.core.config import LocalPath
from ba_torchrl.record.results import POLICY_SUFFIX


class Settings(evaluate.EpisodeSettings):
    """Settings of this command: those of the policy's test, and the file."""

    policy: LocalPath
    """A run folder, one of the checkpoints in it, or a .safetensors file."""
    path: NewPath | None = None
    """New file; null for one named after the task."""
    device: Text = "cpu"
    """Where the policy is computed."""
    episodes: int = Field(default=500, ge=1)
    """Episodes of the policy's test."""


def main(settings: Settings) -> None:
    """Test the policy, and write it with the result."""
    from ba_torchrl.training import policy as policies

    policy = settings.load()
    path = Path(settings.path or f"{policy.task.replace('/', '_')}{POLICY_SUFFIX}")
    check_new(path)
    check_writable_file(path, suffixes=(POLICY_SUFFIX,))
    policies.check_version(policy)
    policies.round_weights(policy)
    result = policies.save_policy(policy, path, evaluate.play(policy, settings))
    print(evaluate.success_text(result.last.success_rate, result.last.episodes, result.task))
    print(f"  policy  {path}, {path.stat().st_size / 1e6:.2f} MB")
    print(f"  check   {policies.evaluate_command(path, result)}")


COMMAND = Command(main, Settings, positional="policy")
