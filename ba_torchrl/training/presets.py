"""Presets: files in ``configs`` that give values of a run a name. Hydra composes them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf, read_write

from ba_torchrl.algorithms.config import ALGORITHMS, NETWORKS
from ba_torchrl.core.config import defaults_of
from ba_torchrl.core.errors import ConfigError, PartError, SettingsError, UnknownNameError
from ba_torchrl.training.collectors.config import COLLECTORS
from ba_torchrl.training.grid.launchers.base import LAUNCHERS

GROUPS = {
    "algorithm": ALGORITHMS,
    "network": NETWORKS,
    "collector": COLLECTORS,
    "launcher": LAUNCHERS,
}
"""By folder of presets in ``configs``, the registry from which they choose."""

_PARTS = ("replay", "rotation")
"""Parts of an algorithm that have presets of their own."""

_plugin_presets: dict[str, set[str]] = {}
"""By group, the entries of plugins, which are presets."""

_search_path: list[str] = []
"""Override of Hydra that names a further folder of presets; empty without one."""


@contextmanager
def started(folder: Path, further: Path | None = None) -> Iterator[None]:
    """Context in which `preset` reads the presets of a folder, such as ``configs``, and of a
    further one."""
    register()
    before = [*_search_path]
    if further is not None:
        path = re.sub(
            r"(\\*)('|$)", lambda m: 2 * m[1] + m[2].replace("'", "\\'"), f"file://{further}"
        )
        _search_path[:] = [f"hydra.searchpath=['{path}']"]
    try:
        with initialize_config_dir(str(folder), version_base="1.3", job_name="ba-torchrl"):
            yield
    finally:
        _search_path[:] = before


@contextmanager
def composed(
    folder: Path,
    name: str,
    overrides: Sequence[str] = (),
    further: Path | None = None,
    given: Mapping[str, Any] | None = None,
) -> Iterator[DictConfig]:
    """Context, as `started`, with the values of a configuration file.

    Args:
        folder: of the configuration files.
        name: of the file.
        overrides: which presets it takes, in Hydra's grammar, such as ``network=equi``.
        further: folder of configuration files; its file of that name is taken.
        given: settings over those of the file, whose parts a label has; they are not set here.

    Raises:
        ConfigError: there is no such preset, or it cannot be read.
    """
    other = None if further is None else further.resolve()
    if other is not None and (other / f"{name}.yaml").exists():
        folder, other = other, folder  # Hydra reads the file before it knows further folders
    with started(folder, other):
        overrides = [*overrides, *_search_path]
        try:
            settings = compose(name, overrides=overrides, return_hydra_config=True)
        except HydraException as error:
            raise _explained(error) from None
        except ValueError as error:  # a preset that is neither a name nor a list
            raise ConfigError(f"{error}; see --help") from None
        with read_write(settings.hydra.runtime):
            _name_parts(settings, given or {}, settings.hydra.runtime.choices)
        HydraConfig.instance().set_config(settings)
        OmegaConf.set_struct(settings, False)  # which settings exist, the models say
        del settings["hydra"]
        try:
            yield settings
        finally:
            HydraConfig.instance().cfg = None


def _name_parts(
    settings: DictConfig, given: Mapping[str, Any], choices: MutableMapping[str, Any]
) -> None:
    """Name the parts that replace those of presets in the choices of presets, which labels have.

    Args:
        settings: composed of presets.
        given: settings over them, such as ``{"network": {"name": "cnn"}}``.
        choices: Hydra's, by group.
    """
    for group, registry in GROUPS.items():
        own, before = given.get(group), settings.get(group)
        if group not in choices or not isinstance(own, Mapping):
            continue
        name = own.get("name", before.name)
        if name not in registry:
            continue  # the model of the settings says so
        defaults = defaults_of(registry[name])
        if name != before.name:
            choices[group] = name
            choices.update({part: "none" for part in _PARTS if part in before.keys() - defaults})
        for part, value in own.items():
            if not isinstance(value, Mapping) or "name" not in value:
                continue
            known, chosen = {**defaults, **before}.get(part), value["name"]
            if isinstance(known, Mapping) and known.get("name") == chosen:
                continue
            if part in _PARTS:
                choices[part] = chosen
            else:
                choices[group] += f"_{part}_{chosen}"


def register() -> None:
    """Make the resolvers of ``configs`` known to Hydra, and the presets of plugins.

    An algorithm or another choice from outside the package is a preset under its registered name.
    """
    OmegaConf.register_new_resolver(
        "if_equal",
        lambda value, other, then, otherwise: then if value == other else otherwise,
        replace=True,
    )
    OmegaConf.register_new_resolver("method", method_name, replace=True)
    OmegaConf.register_new_resolver(
        "file_name", lambda text: str(text).replace("/", "_").replace(" ", "_"), replace=True
    )
    for group, registry in GROUPS.items():
        for name in registry.plugin_names():
            *folders, last = name.split("/")
            node = OmegaConf.create({"name": name})
            where = "/".join([group, *folders])
            ConfigStore.instance().store(group=where, name=last, node=node, package=group)
            _plugin_presets.setdefault(group, set()).add(name)


def method_name(algorithm: str, replay: str, rotation: str) -> str:
    """Return the name of a method, such as "sacfd_per_so2": its presets joined by "_", without
    the presets of uniform replay and no rotation."""
    defaults = ("", "uniform", "none")
    chosen = zip((algorithm, replay, rotation), defaults, strict=True)
    return "_".join(name for name, default in chosen if name != default)


def preset(group: str, name: str) -> dict[str, Any]:
    """Return the values of a preset file; Hydra must have been `started`.

    Args:
        group: folder in ``configs``, such as "algorithm".
        name: of a file in it, or of a plugin's entry; of the group "algorithm" also of a method, as
            `method_name` returns it. rad, drq and ferm have no behaviour term if "sac" follows:
            "rad_sac".

    Raises:
        UnknownNameError: there is no such preset.
    """
    known = preset_names(group)
    first = max((each for each in known if f"{name}_".startswith(f"{each}_")), key=len, default="")
    overrides, parts = [f"+{group}={first}"], name.removeprefix(first).split("_")[1:]
    has_no_behaviour_term = False
    if first in ("rad", "drq", "ferm") and parts[:1] in (["sac"], ["sacfd"]):
        has_no_behaviour_term = parts.pop(0) == "sac"
    for other in _PARTS if group == "algorithm" else ():
        if parts and parts[0] in preset_names(other):
            overrides.append(f"+{other}={parts.pop(0)}")
    if not first or parts:
        raise UnknownNameError(group, name, known)
    found = compose(overrides=[*overrides, *_search_path])
    values = OmegaConf.to_container(found[group], resolve=True)
    return {**values, "imitation": {"name": "none"}} if has_no_behaviour_term else values


def preset_names(group: str) -> list[str]:
    """Return the names of a group's presets; Hydra must have been `started`."""
    files = GlobalHydra.instance().config_loader().get_group_options(group, overrides=_search_path)
    return sorted({*files, *_plugin_presets.get(group, ())})


def name_presets(error: ConfigError, settings: DictConfig) -> None:
    """Let an error on an algorithm or a network have the names of presets, as the user wrote."""
    choices = HydraConfig.get().runtime.choices
    if not isinstance(error, PartError | SettingsError) or error.kind not in GROUPS:
        return
    if error.kind in choices and settings[error.kind].get("name") == error.name:
        error.name = choices[error.kind]
    if isinstance(error, PartError):
        error.instead = _presets_of(error.kind, error.instead)
        return
    fields = {field.split(".")[0] for field, _ in error.problems}
    for group in _PARTS:
        chosen = choices.get(group)
        if group in fields and chosen in preset_names(group) and chosen not in ("uniform", "none"):
            hint = f"{group}={chosen} sets it; this algorithm cannot have it"
            error.problems.append((group, hint))


def _presets_of(group: str, names: Iterable[str]) -> list[str]:
    """Return the names of the presets whose registered name is one of some names."""
    return [each for each in preset_names(group) if preset(group, each)["name"] in names]


def _explained(error: HydraException) -> ConfigError:
    """Return an error of Hydra, with the known names if it is about one that is unknown."""
    first = (str(error) or repr(error.__cause__)).splitlines()[0]
    if isinstance(error, OverrideParseException):
        return ConfigError(f"cannot read {error.override!r}: {first}")
    if isinstance(error, MissingConfigException) and error.missing_cfg_file is not None:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return UnknownNameError(group, name, error.options or ())
    if match := re.match("Could not override '([^']+)'", first):
        return ConfigError(f"{match[1]} is no setting of this command; see --help")
    return ConfigError(first)
