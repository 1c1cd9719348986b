"""The task fulfils the contract of the package's tasks; policies can imitate its expert."""

import my_task  # noqa: F401 -- registers it

from ba_torchrl.testing import check_task


def test_the_expert_solves_the_task():
    report = check_task("mine/my_task", min_success_rate=0.95)
    print(report)
    assert report.warning is None
