"""Measure the experts: success rate and length of random episodes, as a table in Markdown: ``ba-torchrl experts`` in a clone; see ba_torchrl/commands/experts.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["experts", *sys.argv[1:]])
