"""Test the shipped policies, and write the results into their files.

python -m docs.shipped                             # those without a result of this version
python -m docs.shipped close_loop/block_picking    # this one
"""

from __future__ import annotations

import sys

from ba_torchrl import load_policy
from ba_torchrl.commands.evaluate import EpisodeSettings, play
from ba_torchrl.record.results import read_result, shipped_file
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training.policy import save_policy, shipped_policies
from ba_torchrl.training.protocol import PROTOCOL, TEST_EPISODES


def take(task: str, episodes: int = TEST_EPISODES) -> str:
    """Test a shipped policy, and write the result into its file.

    Returns:
        What was written, in one line.
    """
    policy = load_policy(task, device="auto")
    test = play(policy, EpisodeSettings(policy=task, episodes=episodes))
    save_policy(policy, shipped_file(task), test)
    return f"{task}: {test.success_rate:.3f} over {test.episodes} episodes"


def is_tested(task: str) -> bool:
    """Whether the file has a citable result in the present versions of the task and protocol."""
    result = read_result(shipped_file(task))
    present = TASKS[task].version, PROTOCOL
    return result.last.is_citable and (result.task_version, result.protocol) == present


def main() -> None:
    """Test the policies that are named, or those without a result of this version."""
    missing = [task for task in shipped_policies() if not is_tested(task)]
    for task in sys.argv[1:] or missing:
        print(take(task), flush=True)


if __name__ == "__main__":
    main()
