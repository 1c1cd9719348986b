"""The help of a command: each setting with its default, its choices and one line."""

from __future__ import annotations

import re
import shutil
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from ba_torchrl.cli import PROGRAM
from ba_torchrl.core.config import Part, defaults_of, descriptions, parts_of
from ba_torchrl.core.env_config import EnvConfig, env_config_model
from ba_torchrl.core.registry import Registry
from ba_torchrl.demonstrations.formats.base import FORMATS
from ba_torchrl.sim.robots.base import ROBOTS
from ba_torchrl.sim.vision.camera_views import VIEWS
from ba_torchrl.tasks.base import TASKS

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
) -> str:
    """Return the help of a command.

    Args:
        usage: what follows the program's name.
        text: description of the command.
        model: of its settings.
        values: its composed settings, unresolved; the presets among them decide which fields the
            parts of the settings have.
        names: of its configuration files, whose presets can be composed.
    """
    lines = [f"usage: {PROGRAM} {usage}", "", *text.strip().splitlines()]
    registries: Mapping[str, Registry[Any]] = {}
    if names:
        from hydra.core.hydra_config import HydraConfig

        from ba_torchrl.training.presets import GROUPS, preset_names

        registries = GROUPS
        lines += ["", f"--config-name: {' | '.join(names)}"]
        lines += ["--config-dir: a further folder of configurations"]
        lines += ["", "presets:"]
        for group in HydraConfig.get().runtime.choices:
            if "/" not in group:
                lines += _wrapped(f"  {group}=", " | ".join(preset_names(group)))
    parts = list(_parts(model, values, registries))
    expanded = {prefix for _, _, _, prefix in parts}
    for title, model, own, prefix in parts:
        if not model.model_fields:
            continue
        lines += ["", f"{title}:"]
        texts = descriptions(model)
        for name, field in model.model_fields.items():
            if (name in own or field.is_required()) and f"{prefix}{name}." not in expanded:
                lines += _field(f"{prefix}{name}", field, own.get(name), texts.get(name, ""))
    return "\n".join(lines)


def _parts(
    settings: type[BaseModel], values: Mapping[str, Any], registries: Mapping[str, Registry[Any]]
) -> Iterator[tuple[str, type[BaseModel], Mapping[str, Any], str]]:
    """Yield title, model, values and prefix of each part of the settings."""
    yield "settings", settings, values, ""
    if "env" in values:
        task = values.get("task")
        known = isinstance(task, str) and task in TASKS
        model = env_config_model(TASKS[task].Parameters) if known else EnvConfig
        own = {**defaults_of(model), **values["env"]}
        for name in {"seed", "expert", "expert_chunk"} - values["env"].keys():
            del own[name]
        yield f"env, the environment{f' of {task}' if known else ''}", model, own, "env."
    for group, registry in registries.items():
        chosen = values.get(group) or {}
        if chosen.get("name") in registry:
            model = registry[chosen["name"]]
            yield f"{group}={chosen['name']}", model, {**defaults_of(model), **chosen}, f"{group}."


def _field(name: str, field: FieldInfo, value: Any, text: str) -> list[str]:
    parts = parts_of(field.annotation)
    if isinstance(field.default, Part) and isinstance(value, Mapping):
        value = {"name": field.default.name, **value}
    if parts and isinstance(value, Mapping) and value.get("name", "") in parts:
        return _part(name, parts, value, text)
    shown = name
    if not field.is_required() or value not in (None, "???"):
        shown = f"{name}={_short(value)}"
        shown = f"'{shown}'" if isinstance(value, list | tuple | dict) else shown  # for zsh
    choices = _choices(name.split(".")[-1], field.annotation)
    lines = [f"  {shown}" + (f"   {{{', '.join(choices)}}}" if choices else "")]
    return lines + _first_sentence(text)


def _first_sentence(text: str) -> list[str]:
    if not text:
        return []
    text = " ".join(text.replace("`", "").split())
    first = re.split(r"(?<=[^ ]{2}\.) (?=[A-Z\"])", text)[0]
    return _wrapped(" " * _INDENT, first)


def _part(
    name: str, parts: Mapping[str, type[BaseModel]], value: Mapping[str, Any], text: str
) -> list[str]:
    """Return the lines of a field that has fields of its own, those of its choice."""
    chosen, lines = value.get("name", ""), []
    if chosen:
        lines = [f"  {name}.name={chosen}   {{{', '.join(parts)}}}"]
        lines += _first_sentence(text)
    own, texts = {**defaults_of(parts[chosen]), **value}, descriptions(parts[chosen])
    for each, inner in parts[chosen].model_fields.items():
        if each != "name":
            lines += _field(f"{name}.{each}", inner, own[each], texts.get(each, ""))
    return lines


def _short(value: Any) -> str:
    if value is None:
        return "null"
    value = list(value) if isinstance(value, tuple) else value
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
