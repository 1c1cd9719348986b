"""Collect demonstrations from a task's expert or by deconstruction of structures, and save them: ``ba-torchrl collect`` in a clone; see ba_torchrl/commands/collect.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["collect", *sys.argv[1:]])
