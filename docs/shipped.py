"""Test the shipped policies, and write their records, and their numbers on the policies' cards.

python -m docs.shipped                             # those without a record of this file and version
python -m docs.shipped close_loop/block_picking    # this one
"""

from __future__ import annotations

import sys
from hashlib import sha256
from pathlib import Path

from ba_torchrl import load_policy
from ba_torchrl.commands.evaluate import EpisodeSettings, play
from ba_torchrl.core.files import write_text
from ba_torchrl.record.leaderboard import RECORDS
from ba_torchrl.record.results import read_result
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.policy import (
    CARD,
    policy_result,
    read_card,
    shipped_file,
    shipped_policies,
    tested_card,
)
from ba_torchrl.training.protocol import PROTOCOL

EPISODES = 500


def take(task: str, episodes: int = EPISODES) -> str:
    """Test a shipped policy; write its record into the package and its number into its card.

    Returns:
        What was written, in one line.
    """
    policy = load_policy(task, device="auto")
    record = policy_result(policy, play(policy, EpisodeSettings(policy=task, episodes=episodes)))
    file = shipped_file(task)
    card = tested_card(read_card(file), record)
    write_text(record_file(task), record.model_dump_json() + "\n")
    write_text(file.with_suffix(CARD), card.model_dump_json(indent=2) + "\n")
    return f"{task}: {card.success_rate:.3f} over {card.episodes} episodes"


def is_recorded(task: str) -> bool:
    """Whether the package has a citable record of the policy's present file, task and protocol."""
    file = record_file(task)
    if not file.exists():
        return False
    record = read_result(file)
    digest = sha256(shipped_file(task).read_bytes()).hexdigest()
    found = record.policy_file, record.task_version, record.protocol
    return record.last.is_citable and found == (digest, TASKS[task].version, PROTOCOL)


def record_file(task: str) -> Path:
    """Return the file of the record of a shipped policy's test."""
    return RECORDS / f"trained_{task.replace('/', '_')}.json"


def main() -> None:
    """Test the policies that are named, or those without a record."""
    missing = [task for task in shipped_policies() if not is_recorded(task)]
    for task in sys.argv[1:] or missing:
        print(take(task), flush=True)


if __name__ == "__main__":
    main()
