"""Episodes: the scenes of an environment, one per scale of the objects, and their starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from typing_extensions import Self

from ba_torchrl.core.errors import PlacementError
from ba_torchrl.envs.faults import check_bodies
from ba_torchrl.envs.scene import Scene, SceneState

RESET_ATTEMPTS = 50
MAX_REFUSED = 5
"""Scenes in which the objects do not fit before a reset fails."""
SETTLE_STEPS = 100


@dataclass(frozen=True)
class EnvState:
    """The full state of an environment; see `BulletArmEnv.get_state`."""

    origin: tuple[type, str, dict[str, Any]]
    """Class, task and parameters of the environment."""
    scale: float
    scene: SceneState
    observation: dict[str, torch.Tensor]
    memory: dict[str, Any]
    base_seed: int
    episode: int
    step_count: int
    ends: dict[str, bool]
    progress: float

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self  # it never changes


class Episodes:
    """Builds scenes on demand and starts episodes in them.

    Args:
        scales: scales of the objects; every episode draws one.
        build: builds the scene for a scale.
        place_robot: moves the robot of a scene to the initial pose of an episode.
    """

    def __init__(
        self,
        scales: np.ndarray,
        build: Callable[[float], Scene],
        place_robot: Callable[[Scene], None],
    ) -> None:
        self.scales = scales
        self._build = build
        self._place_robot = place_robot
        self._scenes: dict[float, Scene] = {}
        self.scene: Scene | None = None
        """The scene of the current episode."""

    def scene_for(self, scale: float) -> Scene:
        """Return the scene for objects of a scale, built on the first call."""
        key = round(scale, 6)
        if key not in self._scenes:
            self._scenes[key] = self._build(scale)
        return self._scenes[key]

    @property
    def largest_scene(self) -> Scene:
        """The scene with the largest objects."""
        return self.scene_for(float(self.scales[-1]))

    def check_starts(self) -> None:
        """Start one episode with the smallest objects and one with the largest, which must fit."""
        for scale in {float(self.scales[0]), float(self.scales[-1])}:
            self.initialize(self.scene_for(scale), np.random.default_rng(0))

    def scale(self) -> float:
        """Return the scale of the objects in the current episode."""
        return next(key for key, scene in self._scenes.items() if scene is self.scene)

    def restore(self, scale: float, state: SceneState) -> None:
        """Continue the current episode in a state of the scene with objects of a scale."""
        self.scene = self.scene_for(scale)
        self.scene.set_state(state)

    def close(self) -> None:
        """Close all worlds; the next episode builds a new one."""
        for scene in self._scenes.values():
            scene.world.close()
        self._scenes.clear()
        self.forget()

    def forget(self) -> None:
        """Let the next episode place new objects, also if the task continues."""
        self.scene = None

    def begin(self, rng: np.random.Generator, *, with_new_objects: bool) -> Scene:
        """Start an episode; a task that continues keeps the objects of the previous one.

        Args:
            with_new_objects: place new objects even if the task continues.
        """
        scene = self.scene
        if scene is not None and not with_new_objects and scene.task.continues:
            scene.task.resume()
            self._place_robot(scene)
            scene.world.settle(max_steps=SETTLE_STEPS)
            if scene.task.is_valid_start():
                return scene
        self.scene = self.scene_for(float(rng.choice(self.scales)))
        self.initialize(self.scene, rng)
        return self.scene

    def initialize(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place new objects in a scene.

        Raises:
            PlacementError: no attempt gave a valid scene that is not solved, or the objects of
                several attempts did not fit.
        """
        invalid = refused = 0
        outside: list[str] = []
        for _ in range(RESET_ATTEMPTS):
            scene.world.restore_pristine()
            self._place_robot(scene)
            try:
                scene.task.choose_objects(rng)
                scene.task.terrain.initialize_episode(rng)
                scene.task.initialize_episode(rng)
            except PlacementError:
                # the next terrain may be wider and the next objects smaller
                refused += 1
                if refused == MAX_REFUSED:
                    raise
                continue
            scene.world.settle(max_steps=SETTLE_STEPS)
            if scene.task.is_valid_start():
                return
            if not scene.task.is_valid():
                invalid += 1
                outside = scene.task.outside()
        last = f" (the last one {', '.join(outside)})" if outside else ""
        raise PlacementError(
            f"of {RESET_ATTEMPTS} random scenes {invalid} had an object outside the workspace or "
            f"tipped over{last}, {RESET_ATTEMPTS - invalid - refused} were solved from the start, "
            f"and in {refused} the objects did not fit; objects of this size need another workspace"
        )


def evaluate_at_rest(scene: Scene) -> tuple[dict[str, bool], bool]:
    """Carry out the events of the task after an action.

    Return the conditions of success of the scene at rest, and whether it is valid. The scene is
    settled only if all conditions hold before.
    """
    check_bodies(scene)
    steps = scene.world.steps
    scene.task.after_action()
    if scene.world.steps > steps:
        check_bodies(scene)
    conditions = scene.task.conditions()
    if all(conditions.values()):
        scene.world.settle(max_steps=SETTLE_STEPS)
        check_bodies(scene)
        conditions = scene.task.conditions()
    return conditions, scene.task.is_valid()
