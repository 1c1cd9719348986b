"""Strict models of settings, the choices of their parts, and the messages of their errors."""

from __future__ import annotations

import ast
import inspect
import os
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise
from numbers import Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    SerializationInfo,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema
from pydantic_core.core_schema import (
    no_info_plain_validator_function,
    plain_serializer_function_ser_schema,
)

from ba_torchrl.core.errors import ConfigError, SettingsError, UnknownNameError
from ba_torchrl.core.registry import Registry


def numbers_of(values: Any, what: str, count: int = 2) -> tuple[float, ...]:
    """Return the numbers of a list, a tuple or an array as floats.

    Args:
        values: as a user gave them.
        what: is needed, in words.
        count: of the numbers.

    Raises:
        ValueError: there are more or fewer, or one of them is text or a boolean.
    """
    values = values.tolist() if hasattr(values, "tolist") else values
    found = values if isinstance(values, list | tuple) else ()
    is_number = [isinstance(x, Real) and not isinstance(x, bool) for x in found]
    if len(is_number) != count or not all(is_number):
        raise ValueError(f"must be {what}")
    return tuple(float(x) for x in found)


def _pair(values: Any) -> Any:
    return numbers_of(values, "a (low, high) pair of numbers")


Interval = Annotated[tuple[float, float], BeforeValidator(_pair)]

MAX_ENVS = 1024
"""Largest number of environments of a vector: PyBullet's number of worlds."""
MAX_PIXELS = 1024
"""Largest number of rows and columns of an image."""
Source = Literal["expert", "deconstruction"]
"""How demonstrations are made: by an expert, or by reversing deconstruction episodes."""
CompileMode = Literal["default", "reduce-overhead", "max-autotune"]
"""Mode of `torch.compile`; all but the first replay CUDA graphs on a GPU."""
Which = Literal["best", "latest"]
"""Of a run's checkpoints, the one with the highest success rate in evaluation, or the last."""


def expanded(path: str | Path) -> str:
    """Return a path in which the home folder replaces a leading ``~`` or ``~user``.

    Shells replace it at the start of a word alone, and files of configuration are read by none.

    Raises:
        ConfigError: there is no such home folder, or the path has a null character.
    """
    path = str(path)
    if "\0" in path:
        raise ConfigError(f"{path!r} is no path: it has a null character")
    found = os.path.expanduser(path)
    if found.startswith("~"):
        name = path.partition(os.sep)[0]
        raise ConfigError(
            f"{path}: {name} has no home folder on this machine; write the whole path, from /"
        )
    return found


LEROBOT = "lerobot:"
"""Before the folder of a policy that LeRobot trained."""
LocalPath = Annotated[str, Field(min_length=1), AfterValidator(expanded)]
"""The type of every setting that is the path of a file or folder."""


def takes_text(field: FieldInfo) -> bool:
    """Whether a field is a text, or texts, and nothing else but None."""
    return {*_leaves(field.annotation)} <= {str, NoneType, list}


def takes_list(field: FieldInfo) -> bool:
    """Whether a field can be a list."""
    return list in _leaves(field.annotation)


def _leaves(annotation: Any) -> Iterator[Any]:
    """Yield the types of an annotation: of a list ``list``, then those of its items."""
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        yield from _leaves(args[0])
    elif origin in (list, Union, UnionType):
        yield from [list] if origin is list else []
        for each in args:
            yield from _leaves(each)
    else:
        yield annotation


def defaults_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the fields of a model that have a default, as plain values: of a part that is chosen
    by its name, those that differ from the choice's own defaults."""
    return {
        name: _plain(field.get_default(call_default_factory=True))
        for name, field in model.model_fields.items()
        if not field.is_required()
    }


def descriptions(model: type[BaseModel]) -> dict[str, str]:
    """Return the description of each field that has one, by default the docstring below it.

    Pydantic reads the docstrings of every class that is defined, which is a fifth of the time of a
    command line; these are read when they are asked for.
    """
    found: dict[str, str] = {}
    for cls in reversed(model.__mro__):
        if issubclass(cls, BaseModel):
            found |= _docstrings(cls)
    given = {name: field.description for name, field in model.model_fields.items()}
    return {name: given[name] or found[name] for name in given if given[name] or name in found}


def _docstrings(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstrings below the fields of a class, not of its bases."""
    found: Any = _parsed(model.__module__)
    for name in model.__qualname__.split("."):
        body = getattr(found, "body", ())
        classes = (node for node in body if isinstance(node, ast.ClassDef) and node.name == name)
        found = next(classes, None)
    return {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in pairwise(getattr(found, "body", ()))
        if isinstance(field, ast.AnnAssign)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }


@cache
def _parsed(module: str) -> ast.Module | None:
    """Return the parsed source of a module, once for all its classes; None of a module without a
    file."""
    try:
        return ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError, KeyError):
        return None


def _plain(value: Any) -> Any:
    if isinstance(value, Part):
        return {"name": value.name, **value.model_dump(exclude_defaults=True)}
    return value.model_dump() if isinstance(value, BaseModel) else value


def explain(
    error: ValidationError,
    model: type[BaseModel],
    what: str,
    known: Iterable[str] | None = None,
    name: str = "",
) -> SettingsError:
    """Return pydantic's errors of a model as one `SettingsError` that says what is allowed;
    arguments as for `parse`."""
    problems, alternatives = [], []
    for item in error.errors():
        if _is_inner(item):
            continue
        names, owner, parts = _place(model, item["loc"])
        field, kind = ".".join(names) if names else "configuration", item["type"]
        if kind == "extra_forbidden":
            is_known, hint = owner is model and known is not None, ""
            if item["loc"][-2:-1] and item["loc"][-2] in parts:  # the name of a choice
                key = ".".join([*names[:-1], "name"])
                others = [each for each, part in parts.items() if names[-1] in part.model_fields]
                hint = f" ({key}={' or '.join(others)} has it)" if others else ""
            fields = known if is_known else (owner or model).model_fields
            text = str(UnknownNameError("parameter", field, sorted(fields), hint))
        elif kind == "union_tag_invalid":
            text = str(UnknownNameError(f"{field}.name", item["ctx"]["tag"], parts))
        elif kind in ("union_tag_not_found", "model_attributes_type") and parts:
            text = f"{field}.name is missing; known: {', '.join(parts)}"
        else:
            text = f"{field}: {_rule(item)}" if names else _rule(item)
            if len(names) < len([step for step in item["loc"] if step not in parts]):
                alternatives.append(len(problems))
        problems.append((field, text))
    return SettingsError(what, name, _joined(problems, alternatives))


def _joined(problems: list[tuple[str, str]], alternatives: Sequence[int]) -> list[tuple[str, str]]:
    """Return problems in which those of the alternatives of one field are one; of a field and of
    its items, those of the items."""
    out, joined = [], dict[str, str]()
    for number, (field, text) in enumerate(problems):
        if number not in alternatives:
            out.append((field, text))
        elif field in joined:
            first, other = joined[field].partition(" (got ")[0], text.removeprefix(f"{field}: ")
            joined[field] = f"{first}, or {other.removeprefix('must be ')}"
        else:
            joined[field] = text
    deepest = {f: t for f, t in joined.items() if not any(o.startswith(f"{f}.") for o in joined)}
    return [*out, *deepest.items()]


RULES = {
    "missing": "is missing",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "int_parsing": "must be a whole number",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "finite_number": "must be a finite number",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "string_too_short": "must not be empty",
    "tuple_type": "must be a list",
    "list_type": "must be a list",
    "too_short": "must have at least {min_length} items",
    "dict_type": "must be names with values, such as {{name: value}}",
    "model_type": "must be names with values, such as {{name: value}}",
    "model_attributes_type": "must be names with values, such as {{name: value}}",
    "literal_error": "must be {expected}",
    "greater_than": "must be greater than {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be at most {le}",
}
"""What pydantic's types of errors ask for."""


def _short(bound: Any) -> Any:
    return int(bound) if isinstance(bound, float) and bound.is_integer() else bound


def _rule(item: Mapping[str, Any]) -> str:
    """Return what a value must be, and what it is if that is short."""
    kind, value = item["type"], item["input"]
    given = repr(value)
    if kind in RULES:
        message = RULES[kind].format(**{k: _short(v) for k, v in item.get("ctx", {}).items()})
        is_named = kind == "missing"
    else:
        message = item["msg"].removeprefix("Value error, ")
        is_named = not item["loc"] or str(value) in message
    if is_named or len(given) >= 80:
        return message
    if kind == "int_type" and isinstance(value, float) and value.is_integer():
        given += f"; write {value:.0f}"
    return f"{message} (got {given})"


def _is_inner(item: Mapping[str, Any]) -> bool:
    """Whether one of pydantic's errors is an `InnerError`."""
    return isinstance(item.get("ctx", {}).get("error"), InnerError)


_ALTERNATIVE = re.compile(
    r"(constrained|function|lax|chain|json|is|nullable)[-\w\[\]().]*|int|float|str|bool|none"
    r"|(list|tuple|dict|set|literal)\[.*\]"
)
"""Pydantic's names of the alternatives of a field."""


def _place(model: Any, loc: Iterable[Any]) -> tuple[list[str], Any, Mapping[str, Any]]:
    """Return the names of an error's place as they are written, the model that has the last of
    them, and the choices there, of which the model is one or the field has one."""
    names: list[str] = []
    owner, parts = model, {}
    for step in loc:
        if step in parts:  # pydantic's name for the choice
            model = parts[step]
            continue
        if model is None and isinstance(step, str) and _ALTERNATIVE.fullmatch(step):
            continue
        names.append(str(step))
        owner, field = model, model.model_fields.get(step) if model else None
        parts = parts_of(field.annotation) if field else parts if owner else {}
        model = next(iter(parts.values())) if len(parts) == 1 else None
    return names, owner, parts


Model = TypeVar("Model", bound=BaseModel)


def parse(
    model: type[Model],
    values: dict[str, Any],
    what: str,
    known: Iterable[str] | None = None,
    name: str = "",
) -> Model:
    """Validate ``values`` as a ``model``.

    Args:
        model: a pydantic model.
        values: field names and their values.
        what: what is being configured, for the error message.
        known: names that the message on an unknown one lists; those of all fields if None.
        name: under which the model was chosen, for the message.

    Raises:
        SettingsError: a name is unknown, a type wrong or a value out of range.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        inner = [item["ctx"]["error"] for item in error.errors() if _is_inner(item)]
        if len(inner) == error.error_count():
            raise inner[0].error from None
        raise explain(error, model, what, known, name) from None


class InnerError(ValueError):
    """An error of a part of settings, which `parse` raises as it is."""

    def __init__(self, error: ConfigError) -> None:
        self.error = error
        super().__init__(error)


def choose(registry: Registry[type[Model]], values: Mapping[str, Any]) -> Model:
    """Return the registered model called ``values["name"]``, filled in.

    Raises:
        ConfigError: the name is missing or unknown, or a value cannot be used.
    """
    rest, kind = dict(values), registry.kind
    name = rest.pop("name", None)
    if name is None:
        raise ConfigError(f"{kind}.name is missing; known: {', '.join(registry)}")
    return parse(registry[name], rest, kind, name=name)


class Chosen:
    """Annotation of a field that has a model of a registry, which files and the command line have
    as its ``name`` and its fields."""

    def __init__(self, registry: Registry[Any]) -> None:
        self.registry = registry

    def __get_pydantic_core_schema__(self, *_: Any) -> CoreSchema:
        written = plain_serializer_function_ser_schema(self.values, info_arg=True)
        return no_info_plain_validator_function(self.model, serialization=written)

    def model(self, values: Any) -> BaseModel:
        """Return the model; `InnerError` if the values cannot be used."""
        if isinstance(values, self.registry.base):
            return values
        if not isinstance(values, Mapping):
            raise ValueError(RULES["dict_type"].format())
        try:
            return choose(self.registry, values)
        except ConfigError as error:
            raise InnerError(error) from None

    def values(self, model: BaseModel, info: SerializationInfo) -> dict[str, Any]:
        """Return the name and the fields of a model."""
        name = self.registry.name_of(type(model))
        return {"name": name, **model.model_dump(mode=info.mode)}


def _take_any_sequence(schema: Any) -> None:
    """Let the lists and tuples of a schema take both; their elements remain strict."""
    if isinstance(schema, dict):
        if schema.get("type") in ("list", "tuple"):
            schema["strict"] = False
        for part in schema.values():
            _take_any_sequence(part)
    elif isinstance(schema, list | tuple):
        for part in schema:
            _take_any_sequence(part)


class StrictModel(BaseModel):
    """Immutable settings that refuse unknown names, wrong types and infinite numbers.

    A list is a tuple where the type asks for one, and the reverse: YAML and JSON have lists only.
    """

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        defer_build=True,  # a command uses few of the models, whose build takes milliseconds each
    )

    @model_validator(mode="before")
    @classmethod
    def _name_parts(cls, values: Any) -> Any:
        """Name the parts that have values but no name: they are the defaults."""
        if not isinstance(values, Mapping):
            return values
        fields = ((name, cls.model_fields.get(name)) for name in values)
        names = {
            name: field.default.name
            for name, field in fields
            if field is not None and isinstance(field.default, Part)
        }
        parts = {
            name: {"name": default, **values[name]}
            for name, default in names.items()
            if isinstance(values[name], Mapping)
        }
        return {**values, **parts}

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: type[BaseModel], handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        schema = handler(source)
        _take_any_sequence(schema)
        return schema


class Part(StrictModel):
    """One of the choices for a part of an algorithm; a Literal `name` tells them apart."""

    name: str


def names_of(part: type[Part]) -> tuple[str, ...]:
    """Return the names that choose a part."""
    return get_args(part.model_fields["name"].annotation)


def parts_of(annotation: Any) -> dict[str, type[BaseModel]]:
    """Return the models that a field can have, by the `name` of a choice; "" if it has none."""
    found = get_args(annotation) or [annotation]
    models = [each for each in found if isinstance(each, type) and issubclass(each, BaseModel)]
    return {
        name: each
        for each in models
        for name in (names_of(each) if issubclass(each, Part) else [""])
    }


def without_replaced(
    model: type[BaseModel], values: Mapping[str, Any], given: Collection[str]
) -> dict[str, Any]:
    """Return the values of a choice without those that belong to a choice which was replaced.

    Args:
        model: the choice.
        values: of its fields, some of them from a preset.
        given: dotted names of the values that override the preset's. Where a ``name`` is among
            them, fields that this choice does not have are left out, unless they are given too.
    """
    names, out = {name.split(".")[0] for name in given}, {}
    for key, value in values.items():
        field = model.model_fields.get(key)
        if field is None and "name" in names and key != "name" and key not in names:
            continue
        part = parts_of(field.annotation).get(_name(value)) if field else None
        below = [name.removeprefix(f"{key}.") for name in given if name.startswith(f"{key}.")]
        out[key] = without_replaced(part, value, below) if part and below else value
    return out


def _name(value: Any) -> str | None:
    """Return the name of a choice, "" if it has none, None if the value is not a choice."""
    return str(value.get("name", "")) if isinstance(value, Mapping) else None


class WorkerOptions(StrictModel):
    """How the environments of a vector are started, and replaced when they fail."""

    parallel: bool | None = True
    """One process per environment, or all in this process, with the same episodes. None chooses
    processes where at least three of them can run at a time: with fewer, their communication takes
    more time than they save (docs/performance.md)."""
    start_method: Literal["spawn", "fork"] = "spawn"
    """How processes start. "fork" takes milliseconds and needs a parent without an open simulator
    and without CUDA; "spawn" takes seconds, and scripts need an ``if __name__ == "__main__":``
    guard."""
    timeout_s: float = Field(default=60.0, gt=0)
    """Seconds after which a process that does not answer is replaced."""
    max_restarts: int = Field(default=5, ge=0)
    """Largest number of failures in a row of a process: of attempts to start it, or of resets and
    steps without a completed step. Ten failures with no undisturbed episode in between end the run
    as well, in collectors ``max_restarts + 1`` if that is more. The end of an idle process does not
    count."""
    start_timeout_s: float = Field(default=120.0, gt=0)
    """Seconds after which a process that does not start is replaced."""
    wait_for_restarts: bool = True
    """Reset the environment of a failed process before the next step. Otherwise it reports faults
    until its new process is ready."""


MAX_SEED = 2**52 - 1
"""The largest seed of a run or a command. Seeds that are derived from it are below 2**32."""
Seed = Annotated[int, Field(ge=0, le=MAX_SEED)]
FIRST_TEST_SEED = 9 * 10**15
"""Seed of the first episode of a test; see `ba_torchrl.training.protocol`. It is exact as a number
of JSON, below 2**53. Its upper 32 bits are above two million: NumPy's seeds [a + 2**32 b, 0] and
[a, b] give the same numbers, those of episode b of seed a."""
PROTOCOL = 1
"""Version of the protocol of tests; rises when the numbers of the same policies change."""


class TaskParameters(StrictModel):
    """The parameters that one task adds to `EnvConfig`; a task without any uses this class."""
