"""Success of tasks as a comparison of two vectors, for learners that relabel goals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Goal:
    """What a task's scene has achieved and what it should, as two vectors of one length.

    They agree with `Task.evaluate`, in which success is defined.

    Args:
        names: of the components; lengths are in metres.
        achieved: from the task to the first vector.
        desired: from the task to the second one.
        radius: the task's attribute that holds the distance below which the goal is reached; None
            if it is reached where no component is less than the desired one.
        landmarks: places in `Task.landmarks` of the goal, which learners get as ``desired`` only.
    """

    names: tuple[str, ...]
    achieved: Callable[[Any], Sequence[float]]
    desired: Callable[[Any], Sequence[float]]
    radius: str | None = None
    landmarks: tuple[int, ...] = ()

    def is_reached(self, task: type, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        """Return whether goals [..., n] are reached, [...] bool."""
        if self.radius is None:
            return (achieved >= desired).all(-1)
        return np.linalg.norm(achieved - desired, axis=-1) < getattr(task, self.radius)
