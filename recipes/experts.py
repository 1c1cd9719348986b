"""``ba-torchrl experts`` in a clone; the code is in ba_torchrl/commands/experts.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["experts", *sys.argv[1:]])
