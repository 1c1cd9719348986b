"""A task and its expert have other versions when they change."""

import pytest

from tests.tasks import fingerprints

RECORDED = fingerprints.read()


def check(task, robots):
    entry = RECORDED.get(task)
    assert fingerprints.is_recorded(task, entry), f"run `{fingerprints.COMMAND}`"
    assert not (found := fingerprints.changes(task, entry, robots)), "\n".join(found)


@pytest.mark.parametrize(("number", "task"), [*enumerate(fingerprints.built_in())])
def test_a_task_and_its_expert_act_as_recorded_for_their_versions(number, task):
    """With kuka, every fourth task also with one of the other robots in turn."""
    robot, *others = fingerprints.ROBOTS
    check(task, (robot, *([others[number // 4 % 3]] if number % 4 == 0 else [])))


@pytest.mark.slow
@pytest.mark.parametrize("task", fingerprints.built_in())
def test_a_task_and_its_expert_act_as_recorded_with_every_robot(task):
    check(task, fingerprints.ROBOTS)


def test_only_tasks_of_the_package_are_recorded():
    assert RECORDED.keys() == set(fingerprints.built_in())
