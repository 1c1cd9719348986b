"""Episodes: the scenes of an environment, one for each scale of the objects, and their starts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ba_torchrl.envs.scene import Scene
from ba_torchrl.errors import PlacementError

RESET_ATTEMPTS = 50
SETTLE_STEPS = 100


class Episodes:
    """Builds scenes on demand and starts episodes in them.

    Args:
        scales: scales of the objects, of which every episode draws one.
        build: builds the scene for a scale.
        place_robot: puts the robot of a scene into the initial pose of an episode.
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
        """The scene of the present episode."""

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
        """Start an episode with the smallest and one with the largest objects.

        Raises:
            PlacementError: the objects do not fit the workspace.
        """
        for scale in {float(self.scales[0]), float(self.scales[-1])}:
            self.initialize(self.scene_for(scale), np.random.default_rng(0))

    def scale(self) -> float:
        """Return the scale of the objects in the present episode."""
        return next(key for key, scene in self._scenes.items() if scene is self.scene)

    def close(self) -> None:
        """Close all worlds; the next episode builds a new one."""
        for scene in self._scenes.values():
            scene.world.close()
        self._scenes.clear()
        self.scene = None

    def begin(self, rng: np.random.Generator, *, with_new_objects: bool) -> Scene:
        """Start an episode, with the objects of the last one where the task continues with them.

        Args:
            rng: draws the scale and the initial poses.
            with_new_objects: place new objects in any case.

        Raises:
            PlacementError: no valid start was found.
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
            PlacementError: no attempt gave a valid scene in which the goal does not hold.
        """
        invalid = 0
        for _ in range(RESET_ATTEMPTS):
            scene.world.restore_pristine()
            self._place_robot(scene)
            scene.task.initialize_episode(rng)
            scene.world.settle(max_steps=SETTLE_STEPS)
            if scene.task.is_valid_start():
                return
            invalid += not scene.task.is_valid()
        raise PlacementError(
            f"of {RESET_ATTEMPTS} random scenes {invalid} had an object outside the workspace and "
            f"{RESET_ATTEMPTS - invalid} were solved from the start; objects of this size need "
            "another workspace"
        )
