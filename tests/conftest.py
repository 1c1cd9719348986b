import functools
import multiprocessing
import os
import sys
import threading

import pytest
import torch

from ba_torchrl.core.processes import end_with


def pytest_configure(config):
    """Forked processes end with that of the tests, whose end pytest-xdist would not notice."""
    is_main_thread = True

    def before():
        nonlocal is_main_thread
        is_main_thread = threading.current_thread() is threading.main_thread()

    def after_in_child():
        if is_main_thread:  # else the child would end with the thread
            end_with(os.getppid())

    os.register_at_fork(before=before, after_in_child=after_in_child)


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("cuda"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture(autouse=True, scope="session")
def no_process_outlives_the_tests():
    """Processes that failed tests have left do not keep that of the tests from ending."""
    yield
    for process in multiprocessing.active_children():
        process.kill()


@pytest.fixture(autouse=True)
def no_folder_stays_on_the_path():
    """Commands add the present folder, whose modules later tests would find."""
    before = list(sys.path)
    yield
    sys.path[:] = before


@pytest.fixture
def figures():
    """Runs draw their figures."""


@pytest.fixture(autouse=True)
def no_figures(request, monkeypatch):
    """Other runs leave their figure empty, whose drawing takes as long as ten small updates."""
    experiment = sys.modules.get("ba_torchrl.training.experiment")

    def plot_curve(config, curve):
        path = config.folder / "learning_curve.png"
        path.touch()
        return path

    if experiment is not None and "figures" not in request.fixturenames:
        monkeypatch.setattr(experiment, "plot_curve", plot_curve)


@pytest.fixture
def cuda(monkeypatch):
    """The CUDA device; float32 has its full precision."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    return torch.device("cuda")


@pytest.fixture(scope="session")
def composed_presets():
    """`presets.preset`, which composes each preset once in all tests."""
    from ba_torchrl.training import presets

    return functools.cache(presets.preset)


@pytest.fixture
def cached_presets(composed_presets, monkeypatch):
    """Grids of the command line take presets that an earlier test has composed."""
    monkeypatch.setattr("ba_torchrl.training.presets.preset", composed_presets)
