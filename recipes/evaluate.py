"""``ba-torchrl evaluate`` in a clone; the code is in ba_torchrl/commands/evaluate.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["evaluate", *sys.argv[1:]])
