"""``ba-torchrl collect`` in a clone; the code is in ba_torchrl/commands/collect.py."""

import sys

from ba_torchrl.cli import main

if __name__ == "__main__":
    main(["collect", *sys.argv[1:]])
