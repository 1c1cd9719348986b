"""What an expert would do next, from the present state of a scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ba_torchrl.envs.episodes import evaluate_at_rest
from ba_torchrl.envs.scene import Scene


def expert_chunk(
    scene: Scene,
    first: np.ndarray,
    horizon: int,
    act: Callable[[Scene, np.ndarray], None],
    choose: Callable[[Scene], np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the expert's next actions: it plays on, and then the scene's state is restored.

    Args:
        scene: in the state in which the chunk begins.
        first: the expert's action in this state, [A].
        horizon: number T of actions.
        act: executes an action in a scene.
        choose: returns the expert's action in a scene.

    Returns:
        [T, A] float32, with the last action repeated after the goal and after the end of a valid
        scene, and bool [T], whether an action comes before.
    """
    kept, is_out_of_reach = scene.get_state(), scene.controller.is_out_of_reach
    actions = [first]
    try:
        while len(actions) < horizon:
            act(scene, actions[-1])
            conditions, is_valid = evaluate_at_rest(scene)
            if not is_valid or all(conditions.values()):
                break
            with scene.world.fixed_poses():  # experts read the same poses many times
                actions.append(choose(scene))
    finally:
        scene.set_state(kept)
        scene.controller.is_out_of_reach = is_out_of_reach
    played = np.arange(horizon) < len(actions)
    return np.stack(actions + [actions[-1]] * (horizon - len(actions))), played
