"""Evaluate a trained policy: ``ba-torchrl evaluate`` in a clone; see ba_torchrl/commands/evaluate.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["evaluate", *sys.argv[1:]])
