"""``ba-torchrl leaderboard`` in a clone; the code is in ba_torchrl/commands/leaderboard.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["leaderboard", *sys.argv[1:]])
