"""What every part of the package uses, none of it particular to a simulator or a task."""

from ba_torchrl.core import keys

__all__ = ["keys"]
