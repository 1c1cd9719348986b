"""The commands of the command line, one per module, called by `ba_torchrl.cli`."""
