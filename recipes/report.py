"""``ba-torchrl report`` in a clone; the code is in ba_torchrl/commands/report.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["report", *sys.argv[1:]])
