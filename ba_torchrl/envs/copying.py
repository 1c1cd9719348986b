"""Copies of an environment: independent environments in the same state."""

from __future__ import annotations

import copy
from typing import Any, ClassVar

import torch
from torchrl.envs import EnvBase
from typing_extensions import Self

from ba_torchrl.envs.scene import SceneState
from ba_torchrl.envs.settings import ResolvedEnv


class CopiesWithState:
    """Mix-in of environments: `copy.copy`, `copy.deepcopy` and `pickle` keep the state.

    The copy is an environment of its own: it has another simulator, without a window, in the same
    state, so that the same actions give the same steps bit by bit in both. Copying saves the state
    of the original as `get_state` does, after which the actions no longer determine its position.
    It takes as long as `make`; to look ahead in one environment, `get_state` and
    ``reset(state, set_state=True)`` are faster.

    Subclasses keep the arguments of the constructor. Of the attributes, those that
    `copied_attributes` names are copied.
    """

    copied_attributes: ClassVar[tuple[str, ...]] = (
        "base_seed",
        "_episode",
        "_step_count",
        "_observation",
        "_memory",
        "_ends",
        "_conditions",
        "_instruction",
        "_progress",
        "_run_type_checks",
        "training",
    )
    """Attributes that do not depend on the simulator; a class can add its own."""

    def __copy__(self) -> Self:
        return copy.deepcopy(self)

    def __reduce__(self) -> tuple[Any, ...]:
        scene = None
        if self._episodes.scene is not None:
            state = self._get_state()
            scene = state.scale, state.scene
        attributes = {
            name: getattr(self, name)
            for cls in type(self).__mro__
            for name in vars(cls).get("copied_attributes", ())
        }
        resolved = self.resolved.changed(render=False)
        return _make_copy, (type(self), resolved, scene, attributes, self.device)


def _make_copy(
    cls: type[EnvBase],
    resolved: ResolvedEnv,
    scene: tuple[float, SceneState] | None,
    attributes: dict[str, Any],
    device: torch.device | None,
) -> EnvBase:
    """Make an environment and set its state.

    Args:
        cls: its class.
        resolved: its task and parameters.
        scene: scale of the objects, and state; None without a scene.
        attributes: values of the attributes that `copied_attributes` names.
        device: of its TensorDicts.
    """
    env = cls(resolved)
    if scene is not None:
        env._episodes.restore(*scene)
    for name, value in attributes.items():
        setattr(env, name, value)
    return env if device is None else env.to(device)
