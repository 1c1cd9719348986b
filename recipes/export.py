"""``ba-torchrl export`` in a clone; the code is in ba_torchrl/commands/export.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["export", *sys.argv[1:]])
