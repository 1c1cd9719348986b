"""``ba-torchrl tasks`` in a clone; the code is in ba_torchrl/commands/tasks.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["tasks", *sys.argv[1:]])
