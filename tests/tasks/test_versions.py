"""A task and its expert have other versions when they change."""

import pytest

from ba_torchrl.tasks.base import TASKS
from tests.tasks import fingerprints

RECORDED = fingerprints.read()
PICKING = "close_loop/block_picking"


def check(task, robots):
    entry = RECORDED.get(task)
    assert fingerprints.is_recorded(task, entry), f"run `{fingerprints.COMMAND}`"
    assert not (found := fingerprints.changes(task, entry, robots)), "\n".join(found)


@pytest.mark.parametrize(("number", "task"), enumerate(fingerprints.built_in()))
def test_a_task_and_its_expert_act_as_recorded_for_their_versions(number, task):
    """With kuka and one of the other robots in turn."""
    robot, *others = fingerprints.ROBOTS
    check(task, (robot, others[number % len(others)]))


@pytest.mark.slow
@pytest.mark.parametrize("task", fingerprints.built_in())
def test_a_task_and_its_expert_act_as_recorded_with_every_robot(task):
    check(task, fingerprints.ROBOTS)


def test_only_tasks_of_the_package_are_recorded():
    assert RECORDED.keys() == set(fingerprints.built_in())


def changed_expert(monkeypatch):
    """Let the expert open the fingers less."""
    act = TASKS[PICKING].expert_command

    def expert_command(self):
        command = act(self)
        return command._replace(opening=0.99 * command.opening)

    monkeypatch.setattr(TASKS[PICKING], "expert_command", expert_command)


def changed_task(monkeypatch):
    """Place the block 5 mm aside."""
    stand = TASKS[PICKING].stand

    def moved(self, body, xy, yaw_rad):
        stand(self, body, (xy[0] + 0.005, xy[1]), yaw_rad)

    monkeypatch.setattr(TASKS[PICKING], "stand", moved)


@pytest.mark.parametrize(
    ("change", "message", "version"),
    [
        (changed_task, "the episodes of close_loop/block_picking with kuka", "version"),
        (changed_expert, "the actions of the expert of close_loop/block_picking", "expert_version"),
    ],
)
def test_a_change_is_noticed_and_needs_a_version(monkeypatch, change, message, version):
    entry = RECORDED[PICKING]
    monkeypatch.setattr(fingerprints, "ROBOTS", ("kuka",))
    monkeypatch.setattr(fingerprints, "NOISY_PLAYS", 1)
    change(monkeypatch)
    (text,) = fingerprints.changes(PICKING, entry)
    assert text.startswith(message)
    assert f"raise BlockPicking.{version} and run `python -m tests.tasks.fingerprints`" in text
    monkeypatch.setattr(TASKS[PICKING], version, getattr(TASKS[PICKING], version) + 1)
    assert not fingerprints.is_recorded(PICKING, entry)
    assert not fingerprints.changes(PICKING, fingerprints.record(PICKING, entry))
