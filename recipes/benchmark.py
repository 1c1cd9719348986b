"""``ba-torchrl benchmark`` in a clone; the code is in ba_torchrl/commands/benchmark.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["benchmark", *sys.argv[1:]])
