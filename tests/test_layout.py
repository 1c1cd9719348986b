"""The layout of the package: one task per file."""

import ast
import importlib
import inspect
from pathlib import Path

import pytest

from ba_torchrl.tasks.base import TASKS, Task
from ba_torchrl.tasks.sloped_terrain import OnSlopes

ROOT = Path(__file__).parents[1]
TASKS_FOLDER = ROOT / "ba_torchrl" / "tasks"
TERRAINS = ("ramp", "bump")
"""Groups of tasks on a terrain with slopes; their files are in `six_dof`, named with the group."""
TASK_FILES = {
    f"{group}/{path.stem}": path
    for group in ("close_loop", "open_loop")
    for path in (TASKS_FOLDER / group).glob("*.py")
    if path.stem != "__init__"
} | {
    path.stem.replace("_", "/", 1): path
    for path in (TASKS_FOLDER / "six_dof").glob("*.py")
    if path.stem != "__init__"
}


def test_every_task_file_is_one_task_of_its_name():
    ours = {task: TASKS[task] for task in TASKS if TASKS[task].__module__.startswith("ba_torchrl.")}
    assert set(TASK_FILES) == set(ours)
    for task, path in TASK_FILES.items():
        assert Path(inspect.getsourcefile(ours[task])) == path
        names = {
            node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.ClassDef)
        }
        module = importlib.import_module(ours[task].__module__)
        tasks = {name for name in names if issubclass(getattr(module, name), Task)}
        assert tasks == {ours[task].__name__}


@pytest.mark.parametrize("task", [task for task in TASKS if task.split("/")[0] in TERRAINS])
def test_a_task_in_six_degrees_of_freedom_is_a_terrain_and_a_flat_task_without_methods(task):
    cls, flat = TASKS[task], TASKS[f"open_loop/{task.split('/')[1]}"]
    terrain, *others = cls.__bases__
    assert issubclass(terrain, OnSlopes)
    assert tuple(others) == flat.__bases__
    assert not any(callable(value) for value in vars(cls).values())
