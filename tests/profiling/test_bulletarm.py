"""The comparison with BulletArm, without BulletArm."""

import json
import sys
from contextlib import closing

import pytest

from ba_torchrl import list_tasks
from recipes.bulletarm import (
    HEADER,
    PIXELS,
    TASKS,
    ba_torchrl_episodes,
    main,
    player,
    row,
    settings_of,
)

STUB = """
import pybullet

pybullet.stepSimulation = lambda: None

class Env:
    def __init__(self, settings):
        self.left = settings["num_objects"]

    def step(self, action):
        print("noise")
        for _ in range(action):
            pybullet.stepSimulation()
        self.left -= 1
        return None, 0.0, not self.left

class Runner:
    def __init__(self, settings):
        self.settings = settings

    def reset(self):
        self.env = Env(self.settings)

    def getNextAction(self):
        return 3

def createEnvs(processes, task, settings, planner_settings):
    assert (processes, task) == (0, "block_stacking")
    return Runner(settings)
"""


@pytest.fixture
def checkout(tmp_path):
    (tmp_path / "bulletarm").mkdir()
    (tmp_path / "bulletarm" / "env_factory.py").write_text(STUB)
    return str(tmp_path)


def test_the_tasks_exist():
    assert set(TASKS) <= set(list_tasks())
    assert len(TASKS) == len(set(TASKS.values())) == 13
    settings = {task: settings_of(task) for task in TASKS}
    assert json.loads(json.dumps(settings)) == settings
    assert settings["open_loop/box_palletizing"]["num_objects"] == 18
    assert {values["obs_size"] for values in settings.values()} == {PIXELS}


def test_a_checkout_an_interpreter_and_a_number_are_checked(checkout, tmp_path, capsys):
    words = {
        "no clone of BulletArm": [str(tmp_path / "elsewhere"), "--python", sys.executable],
        "no program": [checkout, "--python", str(tmp_path / "python")],
        "1 or more": [checkout, "--python", sys.executable, "--steps", "0"],
        "invalid choice": [checkout, "--python", sys.executable, "--tasks", "open_loop/mine"],
    }
    for message, values in words.items():
        with pytest.raises(SystemExit):
            main(values)
        assert message in capsys.readouterr().err


def test_an_episode_of_bulletarm_is_played_by_its_interpreter(checkout):
    job = ("BulletArm", checkout, "open_loop/block_stacking", {"num_objects": 2})
    with player(sys.executable, *job) as episode:
        for _ in range(2):
            steps = episode()
            assert [physics for _, physics in steps] == [3, 3]
            assert all(seconds > 0 for seconds, _ in steps)


def test_a_process_that_ends_is_reported(tmp_path, capfd):
    job = ("BulletArm", str(tmp_path), "open_loop/block_stacking", {})
    ended = pytest.raises(RuntimeError, match="the process of BulletArm ended")
    with player(sys.executable, *job) as episode, ended:
        episode()
    assert "cannot import BulletArm" in capfd.readouterr().err


def test_an_episode_of_this_library():
    task = "close_loop/block_reaching"
    with closing(ba_torchrl_episodes(task, {**settings_of(task), "obs_size": 16})) as episodes:
        steps = next(episodes)
    assert 1 <= len(steps) < 20
    assert all(seconds > 0 for seconds, _ in steps)
    assert sum(physics for _, physics in steps) > 0


def test_a_row_has_medians_and_mean_physics_steps():
    theirs, ours = [(0.3, 100), (0.2, 200), (0.1, 600)], [(0.001, 1), (0.004, 2), (0.0041234, 3)]
    cells = row("mine/task", theirs, ours).split("|")[1:-1]
    assert [cell.strip() for cell in cells] == ["`mine/task`", "200", "4", "50", "300", "2.0"]
    assert len(cells) == HEADER.splitlines()[0].count("|") - 1
