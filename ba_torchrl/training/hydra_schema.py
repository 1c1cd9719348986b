"""What the recipes' YAML files start from: every field with its default, taken from the code.

So any field can be set on the command line, and none is written down twice.
"""

from __future__ import annotations

import difflib
from typing import Any

from hydra import compose
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from pydantic import BaseModel

from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
from ba_torchrl.config import EnvConfig
from ba_torchrl.errors import ConfigError
from ba_torchrl.training.config import SET_BY_THE_EXPERIMENT, ExperimentConfig
from ba_torchrl.training.grid.plan import SET_BY_THE_GRID, BenchmarkConfig


def defaults_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the fields of a model that have a default, as plain values."""
    return {
        name: field.get_default(call_default_factory=True)
        for name, field in model.model_fields.items()
        if not field.is_required()
    }


def register() -> None:
    """Make the schemas known to Hydra: environment, experiment, grid, each algorithm and network.

    Under ``algorithm``, ``network`` and ``per_...`` of a grid anything may be set: what there is
    depends on the presets, and is checked against them.
    """
    store = ConfigStore.instance()
    env = {
        name: value
        for name, value in defaults_of(EnvConfig).items()
        if name not in SET_BY_THE_EXPERIMENT
    }
    # open: a task adds parameters of its own, which are checked against the task
    environment = OmegaConf.create({"env": env})
    OmegaConf.set_struct(environment.env, False)
    store.store(name="environment", node=environment)
    experiment = OmegaConf.create({**defaults_of(ExperimentConfig), "env": env})
    OmegaConf.set_struct(experiment.env, False)
    store.store(name="experiment", node=experiment)
    shared = {name: value for name, value in experiment.items() if name not in SET_BY_THE_GRID}
    grid = OmegaConf.create(
        {**defaults_of(BenchmarkConfig), **shared, "algorithm": {}, "network": {}}
    )
    for name in ("env", "algorithm", "network", "per_task", "per_algorithm", "per_network"):
        OmegaConf.set_struct(grid[name], False)
    store.store(name="grid", node=grid)
    for group, registry in (("algorithm", ALGORITHMS), ("network", NETWORKS)):
        for name in registry:
            node = {"name": name, **defaults_of(registry[name])}
            store.store(group=f"{group}/schema", name=name, node=node)
    OmegaConf.register_new_resolver(
        "file_name", lambda text: text.replace("/", "_").replace(" ", "_"), replace=True
    )


def preset(group: str, name: str) -> dict[str, Any]:
    """Return the values of a preset file, every default filled in.

    Args:
        group: folder in ``configs``, such as "algorithm".
        name: of a file in it. Hydra must have been started with that ``configs`` folder.

    Raises:
        ConfigError: there is no such file; the message lists those there are.
    """
    known = GlobalHydra.instance().config_loader().get_group_options(group)
    if name not in known:
        close = difflib.get_close_matches(name, known, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise ConfigError(f"unknown {group} {name!r}.{hint} Known: {', '.join(known)}")
    settings = compose(overrides=[f"+{group}={name}"])
    return OmegaConf.to_container(settings[group], resolve=True)
