"""The layout of the package: one task per file, short files, shallow classes."""

import importlib
import inspect
import pickle
import pkgutil
from pathlib import Path

import pytest

import ba_torchrl
from ba_torchrl.config import StrictModel
from ba_torchrl.tasks.base import TASKS, Task

ROOT = Path(__file__).parents[1]
SOURCES = sorted(
    path for folder in ("ba_torchrl", "recipes", "tests") for path in (ROOT / folder).rglob("*.py")
)
MOST_LINES = 400


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


def test_a_task_is_in_a_file_of_its_control_with_its_name():
    """Houses share one file, and the tasks on slopes are a table."""
    for task, cls in ((task, TASKS[task]) for task in TASKS):
        if not cls.__module__.startswith("ba_torchrl."):
            continue
        group, name = task.split("/")
        module = cls.__module__.removeprefix("ba_torchrl.tasks.")
        if group in ("ramp", "bump"):
            assert module == "six_dof"
        else:
            file = "houses" if group == "open_loop" and "house" in name else name
            assert module == f"{group}.{file}"
        assert cls.__name__.lower().endswith(name.replace("_", ""))
        assert pickle.loads(pickle.dumps(cls)) is cls


def test_no_class_is_more_than_three_levels_below_its_base():
    # `StrictModel` is the root of all settings, as pydantic's BaseModel is; a task on slopes derives
    # from that on level ground
    classes = {cls for cls in own_classes() if not issubclass(cls, Task)} - {StrictModel}
    assert len(classes) > 200

    def depth(cls):
        parents = [parent for parent in cls.__bases__ if parent in classes]
        return 1 + max(map(depth, parents)) if parents else 0

    assert {cls.__qualname__: depth(cls) for cls in classes if depth(cls) > 3} == {}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_is_long(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MOST_LINES
