"""Hydra's schemas of the recipes: every field with its default, taken from the code.

Any field can therefore be set on the command line, and no default is written twice. The fields of
algorithms, networks, collectors and launchers are those of models beside modules that import torch,
which takes seconds; `register_open` makes schemas that do without.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from pydantic import BaseModel

from ba_torchrl.core.config import Part
from ba_torchrl.core.env_config import EnvConfig
from ba_torchrl.core.errors import UnknownNameError
from ba_torchrl.core.plugins import load_plugins
from ba_torchrl.core.registry import Registry
from ba_torchrl.training.config import SET_BY_THE_EXPERIMENT, ExperimentConfig
from ba_torchrl.training.grid.plan import SET_BY_THE_GRID, BenchmarkConfig

GROUPS = ("algorithm", "network", "collector", "launcher")
"""Folders of presets in ``configs`` that choose from a registry."""

_plugin_presets: dict[str, set[str]] = {}
"""By group, the entries of plugins, which are presets."""
_is_complete = [False]
"""Whether the schemas of all choices are those of `register`."""


def defaults_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the fields of a model that have a default, as plain values: of a part that is chosen
    by its name, those that differ from the choice's own defaults."""
    return {
        name: _plain(field.get_default(call_default_factory=True))
        for name, field in model.model_fields.items()
        if not field.is_required()
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Part):
        return {"name": value.name, **value.model_dump(exclude_defaults=True)}
    return value.model_dump() if isinstance(value, BaseModel) else value


@functools.cache
def registries() -> dict[str, Registry[Any]]:
    """Return the registry of each of `GROUPS`; imports torch."""
    from ba_torchrl.algorithms.base import ALGORITHMS, NETWORKS
    from ba_torchrl.training.collectors.base import COLLECTORS
    from ba_torchrl.training.grid.launchers.base import LAUNCHERS

    return dict(zip(GROUPS, (ALGORITHMS, NETWORKS, COLLECTORS, LAUNCHERS), strict=True))


def register(arguments: Sequence[str] = ()) -> None:
    """Make the schemas known to Hydra: environment, experiment, grid, each choice of a group.

    An algorithm or another choice from outside the package is also a preset, under its registered
    name and with its defaults. Under ``algorithm``, ``network`` and ``per_...`` of a grid any field
    may be set: the presets decide which exist, and `plan` checks them.

    Args:
        arguments: of the command line; plugins that it names are imported before.

    Raises:
        ConfigError: a plugin cannot be imported.
    """
    load_plugins(plugins_in(arguments))
    _register_settings()
    store = ConfigStore.instance()
    for group, registry in registries().items():
        for name in registry:
            node = _choice(name, registry[name])
            store.store(group=f"{group}/schema", name=name, node=node)
            if registry.plugin_module(name) is not None:
                *folders, last = name.split("/")
                where = "/".join([group, *folders])
                store.store(group=where, name=last, node=node, package=group)
                _plugin_presets.setdefault(group, set()).add(name)
    _is_complete[0] = True


def register_open(folder: Path) -> None:
    """Make schemas known in which the choices of `GROUPS` can have any fields; imports no torch.

    Args:
        folder: of the presets, whose choices need not be in a registry.
    """
    _register_settings()
    for group in GROUPS:
        texts = (path.read_text(encoding="utf-8") for path in (folder / group).glob("*.yaml"))
        for name in re.findall(r"\bschema/(\w+)", "\n".join(texts)):
            node = OmegaConf.create({"name": name})
            OmegaConf.set_struct(node, False)
            ConfigStore.instance().store(group=f"{group}/schema", name=name, node=node)
    _is_complete[0] = False


@functools.cache
def _choice(name: str, model: type[BaseModel]) -> DictConfig:
    """Return the schema of a choice of a group."""
    node = OmegaConf.create({"name": name, **defaults_of(model)})
    for field in node:
        if OmegaConf.is_dict(node[field]):  # open: the model checks its entries
            OmegaConf.set_struct(node[field], False)
    return node


@functools.cache
def _settings() -> dict[str, DictConfig]:
    """Return the schemas of environment, experiment and grid."""
    env = {
        name: value
        for name, value in defaults_of(EnvConfig).items()
        if name not in SET_BY_THE_EXPERIMENT
    }
    # open: a task adds parameters of its own, which are checked against the task
    environment = OmegaConf.create({"env": env})
    OmegaConf.set_struct(environment.env, False)
    experiment = OmegaConf.create({**defaults_of(ExperimentConfig), "env": env})
    OmegaConf.set_struct(experiment.env, False)
    shared = {name: value for name, value in experiment.items() if name not in SET_BY_THE_GRID}
    grid = OmegaConf.create(
        {**defaults_of(BenchmarkConfig), **shared, "algorithm": {}, "network": {}}
    )
    for name in ("env", "algorithm", "network", "per_task", "per_algorithm", "per_network"):
        OmegaConf.set_struct(grid[name], False)
    return {"environment": environment, "experiment": experiment, "grid": grid}


def _register_settings() -> None:
    """Make the schemas of environment, experiment and grid known, and the resolvers."""
    for name, node in _settings().items():
        ConfigStore.instance().store(name=name, node=node)
    OmegaConf.register_new_resolver(
        "if_equal",
        lambda value, other, then, otherwise: then if value == other else otherwise,
        replace=True,
    )
    OmegaConf.register_new_resolver("method", method_name, replace=True)
    OmegaConf.register_new_resolver(
        "file_name", lambda text: text.replace("/", "_").replace(" ", "_"), replace=True
    )


def method_name(algorithm: str, replay: str, rotation: str) -> str:
    """Return the name of a method, such as "sacfd_per_so2": its presets joined by "_", without
    those of uniform replay and of no rotation."""
    defaults = ("", "uniform", "none")
    chosen = zip((algorithm, replay, rotation), defaults, strict=True)
    return "_".join(name for name, default in chosen if name != default)


def preset(group: str, name: str) -> dict[str, Any]:
    """Return the values of a preset file, every default filled in.

    Args:
        group: folder in ``configs``, such as "algorithm".
        name: of a file in it, or of a plugin's entry; of the group "algorithm" also of a method, as
            `method_name` returns it. rad, drq and ferm have no behaviour term if "sac" follows:
            "rad_sac". Hydra must have been started with that ``configs`` folder.

    Raises:
        UnknownNameError: there is no such preset.
    """
    if not _is_complete[0]:
        register()
    known = preset_names(group)
    first = max((each for each in known if f"{name}_".startswith(f"{each}_")), key=len, default="")
    overrides, parts = [f"+{group}={first}"], name.removeprefix(first).split("_")[1:]
    if first in ("rad", "drq", "ferm") and parts[:1] in (["sac"], ["sacfd"]):
        is_plain = parts.pop(0) == "sac"
        overrides += ["algorithm.imitation.name=none"] if is_plain else []
    for other in ("replay", "rotation") if group == "algorithm" else ():
        if parts and parts[0] in preset_names(other):
            overrides.append(f"+{other}={parts.pop(0)}")
    if not first or parts:
        raise UnknownNameError(group, name, known)
    settings = compose(overrides=overrides)
    return OmegaConf.to_container(settings[group], resolve=True)


def presets_of(group: str, names: Iterable[str]) -> list[str]:
    """Return the names of the presets whose registered name is one of some names."""
    return [each for each in preset_names(group) if preset(group, each)["name"] in names]


def preset_names(group: str) -> list[str]:
    """Return the names of a group's presets; Hydra must have been started."""
    files = GlobalHydra.instance().config_loader().get_group_options(group)
    return sorted({*files, *_plugin_presets.get(group, ())})


def plugins_in(arguments: Iterable[str]) -> list[str]:
    """Return the modules that ``plugins=[...]`` of a command line names.

    Hydra composes the configuration from the presets, so the plugins that add some come first.
    """
    found: list[str] = []
    parser = OverridesParser.create()
    for argument in arguments:
        if argument.lstrip("+").startswith("plugins="):
            with contextlib.suppress(HydraException):  # reported by Hydra itself
                value = parser.parse_override(argument).value()
                names = value if isinstance(value, list) else [value]
                found += [str(name) for name in names]
    return found
