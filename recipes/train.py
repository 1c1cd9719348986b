"""``ba-torchrl train`` in a clone; the code is in ba_torchrl/commands/train.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
