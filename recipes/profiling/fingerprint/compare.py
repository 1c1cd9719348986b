"""Compare two records, with the place and the size of every difference."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from ba_torchrl.core.errors import ConfigError
from profiling.fingerprint.cases import PARTS


class _Trace(BaseModel):
    """Schema of the recorded steps of an episode or a run."""

    model_config = ConfigDict(strict=True)

    steps: list[dict[str, tuple[str, float | list[float]]]]
    facts: dict[str, Any]


class _CaseRecord(BaseModel):
    """Schema of the record of a case."""

    model_config = ConfigDict(strict=True)

    part: str
    task: str
    facts: dict[str, Any]
    traces: dict[str, _Trace]


class _Record(BaseModel):
    """Schema of a record."""

    model_config = ConfigDict(strict=True)

    parts: list[Literal[PARTS]]
    versions: dict[str, str]
    cases: dict[str, _CaseRecord]


def read_record(path: str | Path) -> dict[str, Any]:
    """Read a file that `recipes/fingerprint.py` wrote.

    Raises:
        ConfigError: it cannot be opened, or is no such file.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        _Record.model_validate_json(text)
        return json.loads(text)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0]
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            reason = f"{'.'.join(map(str, first['loc'])) or 'content'}: {first['msg']}"
        raise ConfigError(f"{path} is not a record: {reason}") from None


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return the differences of two records of a case as lines of text, [] if there are none."""
    lines = _fact_lines("", old["facts"], new["facts"])
    for name in [*old["traces"], *(name for name in new["traces"] if name not in old["traces"])]:
        before, after = old["traces"].get(name), new["traces"].get(name)
        if before is None or after is None:
            lines.append(f"{name}: only in the {'old' if after is None else 'new'} record")
            continue
        lines += _step_lines(name, before["steps"], after["steps"])
        lines += _fact_lines(f"{name}: ", before["facts"], after["facts"])
    return lines


def _fact_lines(prefix: str, old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    return [
        f"{prefix}{name}: {old.get(name, 'missing')} -> {new.get(name, 'missing')}"
        for name in [*old, *(name for name in new if name not in old)]
        if repr(old.get(name)) != repr(new.get(name))
    ]


def _step_lines(name: str, old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[str]:
    """Return for every key the first step that differs and the greatest difference."""
    lines = []
    if len(old) != len(new):
        lines.append(f"{name}: {len(old)} -> {len(new)} recorded steps")
    first: dict[str, tuple[int, str]] = {}
    count: dict[str, int] = {}
    greatest: dict[str, float] = {}
    for i, (before, after) in enumerate(zip(old, new, strict=False)):
        for key in [*before, *(key for key in after if key not in before)]:
            if key not in before or key not in after:
                text, size = f"only in the {'old' if key in before else 'new'} record", math.nan
            elif before[key][0] == after[key][0]:
                continue
            else:
                text, size = _size(before[key][1], after[key][1])
            first.setdefault(key, (i, text))
            count[key] = count.get(key, 0) + 1
            greatest[key] = max(greatest.get(key, -math.inf), size)
    for key, (i, text) in sorted(first.items(), key=lambda item: item[1][0]):
        line = f"{name}: step {i}: {key}: {text}"
        if count[key] > 1:
            line += f"; {count[key]} steps differ, by at most {greatest[key]:.3g}"
        lines.append(line)
    return lines


def _size(old: Any, new: Any) -> tuple[str, float]:
    """Return the difference of two recorded values, as text and as a number."""
    if isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            return f"{len(old)} -> {len(new)} numbers", math.nan
        gaps = [0.0 if repr(a) == repr(b) else abs(a - b) for a, b in zip(old, new, strict=True)]
        size = max(gaps, default=0.0)
        return f"difference {size:.3g}, {_short(old)} -> {_short(new)}", size
    if isinstance(old, list) or isinstance(new, list):
        return "of another size", math.nan
    size = abs(old - new)
    return f"sum differs by {size:.3g} ({old:.9g} -> {new:.9g})", size


def _short(values: list[float]) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"


def compare(old: dict[str, dict[str, Any]], new: dict[str, dict[str, Any]]) -> dict[str, list[str]]:
    """Return the differences of all cases that differ, by name of the case."""
    found = {}
    for name in [*old, *(name for name in new if name not in old)]:
        if name not in old or name not in new:
            found[name] = [f"only in the {'old' if name in old else 'new'} record"]
        elif lines := differences(old[name], new[name]):
            found[name] = lines
    return found
