"""Run a benchmark: tasks x algorithms x networks x seeds. The same command continues a grid: ``ba-torchrl benchmark`` in a clone; see ba_torchrl/commands/benchmark.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["benchmark", *sys.argv[1:]])
