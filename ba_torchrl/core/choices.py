"""Names among which settings choose; known without the import of torch."""

from __future__ import annotations

from typing import Literal

Control = Literal["open_loop", "close_loop"]
"""Control of a task."""
Precision = Literal["auto", "float32", "bfloat16"]
"""Number format of convolutions; see `ba_torchrl.modules.layers.compute_dtype`."""
ActionDistance = Literal["mse", "kl"]
"""Distance of a policy's action from the expert's; see `ba_torchrl.objectives.distance`."""
WeightedTerms = Literal["none", "critic", "critic_and_policy", "all"]
"""Terms of a loss that importance weights multiply: the error of the values; also the policy's
objective; also the terms on demonstrations and the entropy temperature."""
WeightNorm = Literal["max", "mean"]
"""Normalisation of a batch's importance weights, see `ba_torchrl.objectives.base`."""
Imitation = Literal["none", "executed", "expert", "expert_everywhere"]
"""Which action an algorithm imitates, and on which transitions:

- "none": no action. All transitions of a demonstration are one.
- "executed": ``action``, on demonstrations, except where it is a random action.
- "expert": ``target_action``, on demonstrations: the expert's action, or, in episodes without
  ``expert_action``, as "executed".
- "expert_everywhere": the same, and the expert's action in every state that the policy visits, in
  which the environment then returns it.
"""
