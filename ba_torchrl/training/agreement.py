"""Agreement of a policy with the expert: their actions in the states that the policy visits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ba_torchrl.core import keys
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.tasks.base import TASKS

_CONSTANT = 1e-3
"""Standard deviation below which a component has no correlation."""


class Agreement(NamedTuple):
    """Agreement in one component of the action, over a set of steps."""

    correlation: float | None
    """Of the policy's and the expert's component; None if one of them is constant."""
    difference: float
    """Root of the mean squared difference."""
    spread: float
    """Standard deviation of the expert's component."""


def check_comparable(task: str) -> None:
    """Check that differences of the task's actions are meaningful.

    Args:
        task: id of the task.

    Raises:
        ConfigError: they are poses with equivalent angles, not displacements.
    """
    if TASKS[task].control != "close_loop":
        raise ConfigError(
            f"expert: compares displacements, and the actions of {task} are poses; leave it false"
        )


def agreements(action: Tensor, expert_action: Tensor) -> list[Agreement]:
    """Return the agreement of each component.

    Args:
        action: of the policy, [N, A].
        expert_action: of the expert in the same states, [N, A].
    """
    found = []
    for ours, theirs in zip(action.double().T, expert_action.double().T, strict=True):
        spreads = [float(each.std(correction=0)) for each in (ours, theirs)]
        is_constant = min(spreads) < _CONSTANT
        correlation = None if is_constant else float(torch.stack([ours, theirs]).corrcoef()[0, 1])
        difference = float((ours - theirs).square().mean().sqrt())
        found.append(Agreement(correlation, difference, spreads[1]))
    return found


def agreement_table(episodes: Sequence[TensorDictBase], action_sequence: str) -> str:
    """Return a table in Markdown, one row per component, for first steps and for all.

    A correlation near zero where the expert's actions differ shows a component that the policy has
    not learnt.

    Args:
        episodes: [T] with ``action`` and ``expert_action``.
        action_sequence: one letter per component.
    """
    lines = [
        "| component | steps | correlation | rms difference | expert's standard deviation |",
        "|---|---|---|---|---|",
    ]
    first = torch.stack(
        [episode[0].select(keys.ACTION, keys.EXPERT_ACTION) for episode in episodes]
    )
    every = torch.cat([episode.select(keys.ACTION, keys.EXPERT_ACTION) for episode in episodes])
    for name, steps in (("first", first), ("all", every)):
        found = agreements(steps[keys.ACTION], steps[keys.EXPERT_ACTION])
        for letter, each in zip(action_sequence, found, strict=True):
            correlation = "-" if each.correlation is None else f"{each.correlation:.2f}"
            lines.append(
                f"| {letter} | {name} | {correlation} | {each.difference:.2f} | {each.spread:.2f} |"
            )
    return "\n".join(lines)
