"""The layout of the package: one task per file."""

import pickle

from ba_torchrl.tasks.base import TASKS


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
            file = "covid" if name == "covid_test" else file
            assert module == f"{group}.{file}"
        assert cls.__name__.lower().endswith(name.replace("_", ""))
        assert pickle.loads(pickle.dumps(cls)) is cls
