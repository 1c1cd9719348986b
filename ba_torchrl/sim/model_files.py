"""Model files (URDF, SDF): the reason why PyBullet cannot load one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import pybullet

from ba_torchrl.errors import SimulationError


@contextlib.contextmanager
def loading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Replace PyBullet's error, which gives no reason, by one that does.

    Args:
        path: of the model.

    Raises:
        OSError: the file cannot be opened: it is missing, or too many files are open.
        SimulationError: it can be opened, but PyBullet does not load it.
    """
    try:
        yield
    except pybullet.error as error:
        with open(path, "rb"):
            raise SimulationError(f"PyBullet cannot load {path}: {error}") from error
