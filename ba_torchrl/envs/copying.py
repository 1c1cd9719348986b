"""Copies of an environment: independent environments in the same state."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, Self

import torch
from torchrl.envs import EnvBase

from ba_torchrl.config import EnvConfig
from ba_torchrl.envs.observations import OBSERVATIONS
from ba_torchrl.envs.scene import SceneState
from ba_torchrl.envs.settings import parse_env_config
from ba_torchrl.plugins import MAIN, import_modules
from ba_torchrl.registry import Registry
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.tasks.base import TASKS


class CopiesWithState:
    """Mix-in of environments: `copy.copy`, `copy.deepcopy` and `pickle` keep the state.

    The copy is an environment of its own: it has another simulator, without a window, in the same
    state, so that the same actions give the same steps bit by bit in both. Copying saves the state
    of the original as `get_state` does, after which the actions no longer determine its position.
    It takes as long as `make`; to look ahead in one environment, `get_state` and `set_state` are
    faster.

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
        "_run_type_checks",
        "training",
    )
    """Attributes that do not depend on the simulator; a class can add its own."""

    def __copy__(self) -> Self:
        return copy.deepcopy(self)

    def __reduce__(self) -> tuple[Any, ...]:
        scene = None
        if self._episodes.scene is not None:
            world = self.scene.world.portable_snapshot()  # of what `get_state` saves and restores
            state = self.get_state()
            scene = state.scale, dataclasses.replace(state.scene, world=world)
        modules = [module for *_, module in registering_modules(self.task_id, self.config)]
        attributes = {
            name: getattr(self, name)
            for cls in type(self).__mro__
            for name in vars(cls).get("copied_attributes", ())
        }
        return _make_copy, (
            type(self),
            self.task_id,
            {**self.config.model_dump(), "render": False},
            [module for module in modules if module not in MAIN],
            scene,
            attributes,
            self.device,
        )


def _make_copy(
    cls: type[EnvBase],
    task_id: str,
    values: dict[str, Any],
    modules: Sequence[str],
    scene: tuple[float, SceneState] | None,
    attributes: dict[str, Any],
    device: torch.device | None,
) -> EnvBase:
    """Make an environment and set its state.

    Args:
        cls: its class.
        task_id: as listed by `ba_torchrl.list_tasks`.
        values: fields of `EnvConfig`.
        modules: outside the package, which register the task or other parts.
        scene: scale of the objects, and state with a portable snapshot; None without a scene.
        attributes: values of the attributes that `copied_attributes` names.
        device: of its TensorDicts.
    """
    import_modules(modules)
    env = cls(task_id, parse_env_config(task_id, values))
    if scene is not None:
        env._episodes.restore(*scene)
    for name, value in attributes.items():
        setattr(env, name, value)
    return env if device is None else env.to(device)


def registering_modules(
    task_id: str, config: EnvConfig
) -> Iterator[tuple[Registry[Any], str, str]]:
    """Yield the parts of an environment that modules outside the package have registered.

    Args:
        task_id: as listed by `ba_torchrl.list_tasks`.
        config: the environment's parameters.

    Yields:
        Registry, name in it, and module.
    """
    parts = [(TASKS, task_id), (ROBOTS, config.robot)]
    parts += [(OBSERVATIONS, name) for name in config.observations]
    for registry, name in parts:
        module = registry.plugin_module(name)
        if module is not None:
            yield registry, name, module
