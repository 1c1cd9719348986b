"""Contract checks of tasks, for tests of tasks inside and outside the package."""

from ba_torchrl.testing.tasks import ExpertReport, check_task

__all__ = ["ExpertReport", "check_task"]
