"""Report the results of runs: curves with standard errors, tables, and a page with videos: ``ba-torchrl report`` in a clone; see ba_torchrl/commands/report.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["report", *sys.argv[1:]])
