"""``python -m ba_torchrl``: the command line."""

from ba_torchrl.cli import main

if __name__ == "__main__":
    main()
