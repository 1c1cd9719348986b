"""Types and shapes of the entries of transitions."""

from __future__ import annotations

import torch
from tensordict.utils import NestedKey

Schema = dict[NestedKey, tuple[torch.dtype, torch.Size]]
"""Type and shape of each entry by key, without the batch dimension."""


def differences(found: Schema, expected: Schema) -> list[str]:
    """Return a description of each entry that differs, sorted."""
    problems = [f"missing {key!r}" for key in expected if key not in found]
    problems += [f"unexpected {key!r}" for key in found if key not in expected]
    problems += [
        f"{key!r} is {_text(*found[key])}, stored as {_text(*expected[key])}"
        for key in expected
        if key in found and found[key] != expected[key]
    ]
    return sorted(problems)


def _text(dtype: torch.dtype, shape: torch.Size) -> str:
    return f"{str(dtype).removeprefix('torch.')}{list(shape)}"
