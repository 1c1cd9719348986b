"""``ba-torchrl play`` in a clone; the code is in ba_torchrl/commands/play.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["play", *sys.argv[1:]])
