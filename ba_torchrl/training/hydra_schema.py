"""What the recipes' YAML files start from: every field with its default, taken from the code.

So any field can be set on the command line, and none is written down twice.
"""

from __future__ import annotations

from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf
from pydantic import BaseModel

from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
from ba_torchrl.config import EnvConfig
from ba_torchrl.training.config import ExperimentConfig

_SET_BY_THE_EXPERIMENT = {"seed", "expert"}


def defaults_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the fields of a model that have a default, as plain values."""
    return {
        name: field.get_default(call_default_factory=True)
        for name, field in model.model_fields.items()
        if not field.is_required()
    }


def register() -> None:
    """Make the schemas known to Hydra: environment, experiment, each algorithm and network."""
    store = ConfigStore.instance()
    env = {
        name: value
        for name, value in defaults_of(EnvConfig).items()
        if name not in _SET_BY_THE_EXPERIMENT
    }
    store.store(name="environment", node={"env": env})
    store.store(name="experiment", node={**defaults_of(ExperimentConfig), "env": env})
    for group, registry in (("algorithm", ALGORITHMS), ("network", NETWORKS)):
        for name in registry:
            node = {"name": name, **defaults_of(registry[name])}
            store.store(group=f"{group}/schema", name=name, node=node)
    OmegaConf.register_new_resolver(
        "file_name", lambda text: text.replace("/", "_").replace(" ", "_"), replace=True
    )
