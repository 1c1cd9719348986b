"""The layout of the package: one task per file, short files, shallow classes."""

import ast
import importlib
import inspect
import pkgutil
from pathlib import Path

import pytest

import ba_torchrl
from ba_torchrl.config import StrictModel
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
SOURCES = sorted(
    path for folder in ("ba_torchrl", "recipes", "tests") for path in (ROOT / folder).rglob("*.py")
)
MOST_LINES = 400


def below(base, cls):
    """Return the number of steps of inheritance from a class up to its base."""
    if cls is base:
        return 0
    return 1 + max(below(base, parent) for parent in cls.__bases__ if issubclass(parent, base))


def own_classes():
    """Return every class of the package."""
    found = set()
    for module in pkgutil.walk_packages(ba_torchrl.__path__, "ba_torchrl."):
        loaded = importlib.import_module(module.name)
        found |= {
            cls
            for _, cls in inspect.getmembers(loaded, inspect.isclass)
            if cls.__module__.startswith("ba_torchrl.")
        }
    return found


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


@pytest.mark.parametrize("task", list(TASKS))
def test_no_task_is_more_than_two_levels_below_the_base(task):
    assert below(Task, TASKS[task]) <= 2


@pytest.mark.parametrize("task", [task for task in TASKS if task.split("/")[0] in TERRAINS])
def test_a_task_in_six_degrees_of_freedom_is_a_terrain_and_a_flat_task_without_methods(task):
    cls, flat = TASKS[task], TASKS[f"open_loop/{task.split('/')[1]}"]
    terrain, *others = cls.__bases__
    assert issubclass(terrain, OnSlopes)
    assert tuple(others) == flat.__bases__
    assert not any(callable(value) for value in vars(cls).values())


def test_no_class_is_more_than_two_levels_below_its_base():
    classes = own_classes() - {StrictModel}  # the root of all settings, as pydantic's BaseModel is
    assert len(classes) > 200

    def depth(cls):
        parents = [parent for parent in cls.__bases__ if parent in classes]
        return 1 + max(map(depth, parents)) if parents else 0

    assert {cls.__qualname__: depth(cls) for cls in classes if depth(cls) > 2} == {}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_is_long(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MOST_LINES
