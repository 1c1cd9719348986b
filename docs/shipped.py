"""Take the records of the tests of the shipped policies, and their numbers for the policies' cards.

ba-torchrl evaluate trained folder=runs/trained episodes=500
python -m docs.shipped runs/trained
"""

from __future__ import annotations

import sys
from hashlib import sha256
from pathlib import Path

from ba_torchrl.core.files import json_bytes, write_text
from ba_torchrl.record.leaderboard import RECORDS
from ba_torchrl.record.results import RunResult
from ba_torchrl.training.policy import CARD, read_card, shipped_file, tested_card


def take(file: Path) -> str:
    """Write the record of a shipped policy's test into the package and its number into the card.

    Returns:
        What was written, in one line.

    Raises:
        ValueError: it is no record, its policy is not the one that is shipped, or it has fewer
            episodes than can be cited.
    """
    record = RunResult.model_validate_json(json_bytes(file))
    policy = shipped_file(record.task)
    if not policy.exists() or record.policy_file != sha256(policy.read_bytes()).hexdigest():
        raise ValueError(f"{file}: another policy of {record.task} is shipped; evaluate it again")
    if not record.last.is_citable:
        raise ValueError(f"{file}: {record.last.episodes} episodes; evaluate with episodes=500")
    card = tested_card(read_card(policy), record)
    write_text(record_file(record.task), record.model_dump_json() + "\n")
    write_text(policy.with_suffix(CARD), card.model_dump_json(indent=2) + "\n")
    return f"{record.task}: {card.success_rate:.3f} over {card.episodes} episodes"


def record_file(task: str) -> Path:
    """Return the file of the record of a shipped policy's test."""
    return RECORDS / f"trained_{task.replace('/', '_')}.json"


def main() -> None:
    """Take all records of a folder."""
    for file in sorted(Path(sys.argv[1]).glob("*.json")):
        print(take(file))


if __name__ == "__main__":
    main()
