"""Write the policy of a run into one file, with a card of its success.

ba-torchrl export runs/my-run     # writes close_loop_block_picking.safetensors
ba-torchrl export runs/my-run path=my-policy.safetensors
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated

from pydantic import Field

from ba_torchrl import load_policy
from ba_torchrl.cli.command import Command
from ba_torchrl.cli.types import Text, check_writable_file, checked
from ba_torchrl.commands import evaluate
from ba_torchrl.training.policy import TENSORS, round_weights, save_policy

PolicyFile = Annotated[Text, checked(functools.partial(check_writable_file, suffixes=(TENSORS,)))]


class Settings(evaluate.EpisodeSettings):
    """Settings of this command: those of the evaluation that the card reports, and the file."""

    path: PolicyFile | None = None
    """File of the policy; the card is beside it. Null for a file named after the task."""
    device: Text = "cpu"
    """Where the policy is computed."""
    episodes: int = Field(default=200, ge=1)
    """Episodes of the card."""


def main(settings: Settings) -> None:
    """Evaluate the policy, and write it with its card."""
    policy = load_policy(settings.policy, settings.which, settings.device)
    path = Path(settings.path or f"{policy.task.replace('/', '_')}{TENSORS}")
    check_writable_file(path)
    round_weights(policy)
    found = evaluate.play(policy, settings)
    seed = policy.test_seed if settings.seed is None else settings.seed
    card = save_policy(
        policy,
        path,
        successes=found.successes,
        episodes=found.episodes,
        seed=seed,
        num_envs=settings.num_envs,
    )
    low, high = card.interval
    print(
        f"success_rate {card.success_rate:.2f} (95 % interval {low:.2f} to {high:.2f}) over "
        f"{card.episodes} episodes of {card.task}"
    )
    print(f"  policy  {path}, {path.stat().st_size / 1e6:.2f} MB")
    print(f"  check   {card.evaluate}")


COMMAND = Command(main, Settings, positional="policy")
