"""Conversion of rollouts to the transitions that the replay stores."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDict, TensorDictBase

from ba_torchrl.envs import keys


def as_transitions(
    tensordict: TensorDictBase,
    images: Iterable[str],
    *,
    is_expert: bool,
    expert_action: bool = False,
) -> TensorDict:
    """Return the transitions [N] of a rollout with the entries that the replay stores.

    Args:
        tensordict: transitions of any batch shape.
        images: keys of the images to store.
        is_expert: whether the transitions are demonstrations. Those whose entry ``is_expert`` is
            False are not, unless the expert's action in their state is known and stored.
        expert_action: also store ``expert_action``; a copy of the action where it is not known.

    Raises:
        KeyError: an entry is missing.
    """
    flat = tensordict if tensordict.ndim == 1 else tensordict.reshape(-1)  # [0] has no reshape
    state = [*images, keys.HOLDING]
    ends = (keys.REWARD, keys.DONE, keys.TERMINATED, keys.TRUNCATED, keys.FAULT)
    out = flat.select(*state, keys.ACTION, *((keys.NEXT, key) for key in (*state, *ends)))
    is_labelled = expert_action and keys.EXPERT_ACTION in flat
    out[keys.IS_EXPERT] = torch.full((len(flat), 1), is_expert)
    if is_expert and not is_labelled and keys.IS_EXPERT in flat:
        out[keys.IS_EXPERT] = flat[keys.IS_EXPERT].clone()
    if expert_action:
        out[keys.EXPERT_ACTION] = flat[keys.EXPERT_ACTION if is_labelled else keys.ACTION].clone()
    return out
