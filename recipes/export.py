"""Write the policy of a run into one file, with a card of its success: ``ba-torchrl export`` in a clone; see ba_torchrl/commands/export.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["export", *sys.argv[1:]])
