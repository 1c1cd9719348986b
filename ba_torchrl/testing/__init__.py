"""Contract checks of tasks, for tests of tasks inside and outside the package."""

from ba_torchrl.testing.tasks import check_task

__all__ = ["check_task"]
