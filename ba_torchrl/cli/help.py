"""The help of a command: each setting with its default, its choices and one line."""

from __future__ import annotations

import re
import shutil
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin

from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from ba_torchrl.cli import PROGRAM
from ba_torchrl.core.config import parts_of
from ba_torchrl.core.env_config import EnvConfig, env_config_model
from ba_torchrl.demonstrations.formats.base import FORMATS
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.vision.camera_views import VIEWS
from ba_torchrl.tasks.base import TASKS
from ba_torchrl.training import hydra_schema

CHOICES = {
    "format": FORMATS,
    "robot": ROBOTS,
    "robots": ROBOTS,
    "view_type": VIEWS,
}
"""Registries that fields of these names choose from."""
_INDENT = 6


def describe(
    usage: str,
    text: str,
    model: type[BaseModel],
    values: Mapping[str, Any],
    names: Sequence[str],
    with_choices: bool,
) -> str:
    """Return the help of a command.

    Args:
        usage: what follows the program's name.
        text: description of the command.
        model: of its settings.
        values: its composed settings, unresolved; the presets among them decide which fields the
            parts of the settings have.
        names: of its configuration files.
        with_choices: whether the fields of the chosen algorithm, network, collector and launcher
            are listed, whose models import torch.
    """
    lines = [f"usage: {PROGRAM} {usage}", "", *text.strip().splitlines()]
    if names:
        lines += ["", f"--config-name: {' | '.join(names)}"]
        lines += ["--config-dir: a further folder of configurations"]
        lines += ["", "presets:"]
        for group in HydraConfig.get().runtime.choices:
            if "/" not in group:
                lines += _wrapped(f"  {group}=", " | ".join(hydra_schema.preset_names(group)))
    parts = list(_parts(model, values, with_choices))
    expanded = {prefix for _, _, _, prefix in parts}
    for title, model, own, prefix in parts:
        lines += ["", f"{title}:"]
        for name, field in model.model_fields.items():
            if (name in own or field.is_required()) and f"{prefix}{name}." not in expanded:
                lines += _field(f"{prefix}{name}", field, own.get(name))
    chosen = _chosen(values)
    if chosen and not with_choices:
        choices = HydraConfig.get().runtime.choices
        words = " ".join(f"{group}={choices[group]}" for group in chosen)
        lines += ["", f"fields of {', '.join(chosen)}: {PROGRAM} {usage.split()[0]} --help {words}"]
    return "\n".join(lines)


def _parts(
    settings: type[BaseModel], values: Mapping[str, Any], with_choices: bool
) -> Iterator[tuple[str, type[BaseModel], Mapping[str, Any], str]]:
    """Yield title, model, values and prefix of each part of the settings."""
    yield "settings", settings, values, ""
    if "env" in values:
        task = values.get("task")
        known = isinstance(task, str) and task != MISSING
        model = env_config_model(TASKS[task].Parameters) if known else EnvConfig
        own = {**hydra_schema.defaults_of(model), **values["env"]}
        for name in {"seed", "expert"} - values["env"].keys():
            del own[name]
        yield f"env, the environment{f' of {task}' if known else ''}", model, own, "env."
    for group in _chosen(values) if with_choices else ():
        chosen, registry = values[group], hydra_schema.registries()[group]
        if chosen["name"] in registry:
            model = registry[chosen["name"]]
            yield f"{group}={chosen['name']}", model, chosen, f"{group}."


def _chosen(values: Mapping[str, Any]) -> list[str]:
    """Return the groups of presets from which the settings choose."""
    return [group for group in hydra_schema.GROUPS if (values.get(group) or {}).get("name")]


def _field(name: str, field: FieldInfo, value: Any) -> list[str]:
    parts = parts_of(field.annotation)
    if parts and isinstance(value, Mapping) and value.get("name", "") in parts:
        return _part(name, field, parts, value)
    shown = name
    if not field.is_required() or value not in (None, "???"):
        shown = f"{name}={_short(value)}"
        shown = f"'{shown}'" if isinstance(value, list | tuple | dict) else shown  # for zsh
    choices = _choices(name.split(".")[-1], field.annotation)
    lines = [f"  {shown}" + (f"   {{{', '.join(choices)}}}" if choices else "")]
    return lines + _description(field)


def _description(field: FieldInfo) -> list[str]:
    """Return the first sentence of a field's description."""
    if not field.description:
        return []
    text = " ".join(field.description.replace("`", "").split())
    first = re.split(r"(?<=[^ ]{2}\.) (?=[A-Z\"])", text)[0]
    return _wrapped(" " * _INDENT, first)


def _part(
    name: str, field: FieldInfo, parts: Mapping[str, type[BaseModel]], value: Mapping[str, Any]
) -> list[str]:
    """Return the lines of a field that has fields of its own, those of its choice."""
    chosen, lines = value.get("name", ""), []
    if chosen:
        lines = [f"  {name}.name={chosen}   {{{', '.join(parts)}}}"]
        lines += _description(field)
    own = {**hydra_schema.defaults_of(parts[chosen]), **value}
    for each, inner in parts[chosen].model_fields.items():
        if each != "name":
            lines += _field(f"{name}.{each}", inner, own[each])
    return lines


def _short(value: Any) -> str:
    if value is None:
        return "null"
    text = str(value).lower() if isinstance(value, bool) else str(value).replace("'", "")
    return text if len(text) < 60 else f"{text[:57]}..."


def _choices(name: str, annotation: Any) -> list[str]:
    if name in CHOICES:
        return list(CHOICES[name])
    return [_short(value) for value in _literals(annotation)]


def _literals(annotation: Any) -> Iterator[Any]:
    if get_origin(annotation) is Literal:
        yield from get_args(annotation)
    elif get_origin(annotation) in (Union, types.UnionType):
        for part in get_args(annotation):
            yield from _literals(part)


def _wrapped(start: str, text: str) -> list[str]:
    width = max(60, min(shutil.get_terminal_size().columns, 110))
    return textwrap.wrap(
        text, width, initial_indent=start, subsequent_indent=" " * max(_INDENT, len(start))
    )
