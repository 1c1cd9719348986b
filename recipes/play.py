"""Show a task: the expert, random actions or a trained policy, in a video or in a window: ``ba-torchrl play`` in a clone; see ba_torchrl/commands/play.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["play", *sys.argv[1:]])
