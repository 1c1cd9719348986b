"""Description of a task, `ba_torchrl.describe`, and the headings under which tasks are listed."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from ba_torchrl.core.config import descriptions
from ba_torchrl.tasks.base import TASKS, Versions, versions_of

EXPERT_SCORES = "expert_scores.json"
"""File of `ba_torchrl.tasks`: by task and robot, what ``ba-torchrl experts`` measured."""

_SIX_DOF = "Six degrees of freedom: ramps, bumps"
_HEADINGS = {
    "close_loop": "Close loop",
    "open_loop": "Open loop",
    "ramp": _SIX_DOF,
    "bump": _SIX_DOF,
}
"""Heading of each group of tasks, the part of their ids before the slash. The heading of a group
that is not listed, such as a plugin's, is its name."""


@dataclass(frozen=True)
class ExpertScore:
    """Score of a task's expert with a robot over random episodes."""

    episodes: int
    success_rate: float
    mean_length: float | None = None
    """Steps of the successful episodes; None where they were not noted."""

    def __str__(self) -> str:
        steps = "" if self.mean_length is None else f" in {self.mean_length:.1f} steps"
        return f"{self.success_rate:.3f}{steps} ({self.episodes} episodes)"


@dataclass(frozen=True)
class TaskDescription:
    """A task, with the parameters that `ba_torchrl.make` gives it by default."""

    task: str
    """Id of the task."""
    versions: Versions
    """Of the task and of its expert."""
    text: str
    """Objects and goal, and what ends an episode early."""
    instruction: str
    """The goal of an episode as a sentence, an example."""
    conditions: tuple[str, ...]
    """Names of the conditions; a success fulfils all of them."""
    randomised: tuple[str, ...]
    """What differs from episode to episode."""
    observations: dict[str, tuple[int, ...]]
    """Shape of each observation, by key."""
    actions: dict[str, tuple[float, float]]
    """Least and largest value of each component of the action, by name."""
    max_steps: int
    """Steps until the episode is truncated."""
    num_objects: int
    """Number of objects."""
    numbers_of_objects: tuple[int, ...]
    """Allowed values of ``num_objects``."""
    object_scale_range: tuple[float, float]
    """Range of the objects' scale."""
    object_scale_limits: tuple[float, float]
    """Allowed scales."""
    parameters: dict[str, tuple[Any, str]]
    """Default and meaning of each parameter that only this task has, by name."""
    experts: dict[str, ExpertScore]
    """Score of the expert by robot, as far as it was measured."""

    def rows(self) -> dict[str, str]:
        """Return everything except id and text, as text by heading; in brackets what is allowed."""
        rows = {
            "version": f"{self.versions.task}, expert {self.versions.expert}",
            "instruction": self.instruction,
            "success": ", ".join(self.conditions),
            "randomised": "; ".join(self.randomised),
            "observations": ", ".join(
                f"{key} {' x '.join(map(str, shape))}" for key, shape in self.observations.items()
            ),
            "actions": ", ".join(
                f"{name} {low:g} to {high:g}" for name, (low, high) in self.actions.items()
            ),
            "max_steps": f"{self.max_steps}",
            "object_scale_range": (
                f"{_span(self.object_scale_range)} ({_span(self.object_scale_limits)})"
            ),
        }
        if len(self.numbers_of_objects) > 1:
            least, *others = self.numbers_of_objects
            is_whole = others[-1] - least == len(others)
            numbers = ", ".join(map(str, self.numbers_of_objects))
            allowed = _span((least, others[-1])) if is_whole else numbers
            rows["num_objects"] = f"{self.num_objects} ({allowed})"
        for name, (default, meaning) in self.parameters.items():
            rows[name] = f"{default!r}" + (f". {meaning}" if meaning else "")
        if self.experts:
            scores = (f"{robot} {score}" for robot, score in self.experts.items())
            rows["expert"] = ", ".join(scores)
        return rows

    def __str__(self) -> str:
        rows = (f"  {name + ':':20}{value}" for name, value in self.rows().items())
        return "\n".join([self.task, "", self.text, "", *rows])


def _span(limits: tuple[float, float]) -> str:
    """Return a range as text, a single value if both ends are the same."""
    low, high = limits
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def describe(task: str) -> TaskDescription:
    """Return a task's objects, goal, spaces and expert's scores, for its default parameters."""
    from ba_torchrl.envs.factory import make  # imports torch

    cls = TASKS[task]
    env = make(task, seed=0)
    try:
        env.reset()
        instruction = env.instruction
        conditions, components = tuple(env.conditions), env.actions.components
        low, high = env.action_spec.space.low.tolist(), env.action_spec.space.high.tolist()
        observed = {key: tuple(spec.shape) for key, spec in env.observation_spec.items()}
        config = env.config
    finally:
        env.close()
    texts = descriptions(cls.Parameters)
    least, most = cls.num_objects_range
    positions = "positions and yaws" if config.random_orientation else "positions"
    scales = config.object_scale_range
    return TaskDescription(
        task=task,
        versions=versions_of(task),
        text=inspect.cleandoc(cls.__doc__ or ""),
        instruction=instruction,
        conditions=conditions,
        randomised=(f"{positions} of the objects", *(["their scale"] * (scales[0] < scales[1]))),
        observations=observed,
        actions=dict(zip(components, zip(low, high, strict=True), strict=True)),
        max_steps=config.max_steps,
        num_objects=cls.num_objects,
        numbers_of_objects=tuple(range(least, most + 1, cls.num_objects_step)),
        object_scale_range=scales,
        object_scale_limits=cls.scale_limits,
        parameters={
            name: (field.default, " ".join(texts.get(name, "").split()))
            for name, field in cls.Parameters.model_fields.items()
        },
        experts=expert_scores().get(task, {}),
    )


def summary(task: str) -> str:
    """Return the first sentence of a task's goal, or of its description."""
    text = " ".join(inspect.cleandoc(TASKS[task].__doc__ or "").split())
    _, _, goal = text.partition("Goal: ")
    return f"{(goal or text).split('. ')[0].rstrip('.')}."


def tasks_by_heading(tasks: Iterable[str]) -> dict[str, list[str]]:
    """Return the tasks of each heading: the package's first, then others as they occur."""
    found: dict[str, list[str]] = {heading: [] for heading in _HEADINGS.values()}
    for task in tasks:
        group = task.split("/")[0]
        found.setdefault(_HEADINGS.get(group, group), []).append(task)
    return {heading: members for heading, members in found.items() if members}


@cache
def expert_scores() -> dict[str, dict[str, ExpertScore]]:
    """Return the measured scores of the package's experts by task and robot."""
    text = files("ba_torchrl.tasks").joinpath(EXPERT_SCORES).read_text(encoding="utf-8")
    return {
        task: {robot: ExpertScore(**values) for robot, values in robots.items()}
        for task, robots in json.loads(text).items()
    }
