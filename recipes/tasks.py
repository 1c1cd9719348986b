"""List the tasks, describe some of them, or write the page of all: ``ba-torchrl tasks`` in a clone; see ba_torchrl/commands/tasks.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["tasks", *sys.argv[1:]])
