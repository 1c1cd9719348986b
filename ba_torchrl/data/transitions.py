"""Conversion of rollouts to the transitions that the replay stores."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from ba_torchrl.envs import keys


def as_transitions(
    tensordict: TensorDictBase,
    images: Iterable[str],
    *,
    is_expert: bool,
    label: NestedKey | None = None,
) -> TensorDict:
    """Return the transitions [N] of a rollout with the entries that the replay stores.

    Args:
        tensordict: transitions of any batch shape.
        images: keys of the images to store.
        is_expert: whether the transitions are demonstrations. Those whose entry ``is_expert`` is
            False are not, unless ``label`` is ``expert_action``.
        label: entry with the action to imitate, stored as ``expert_action``: ``expert_action`` if
            the expert's action is known, ``action`` for the executed one; None to store none.

    Raises:
        KeyError: an entry is missing.
    """
    flat = tensordict if tensordict.ndim == 1 else tensordict.reshape(-1)  # [0] has no reshape
    state = [*images, keys.HOLDING]
    ends = (keys.REWARD, keys.DONE, keys.TERMINATED, keys.TRUNCATED, keys.FAULT)
    out = flat.select(*state, keys.ACTION, *((keys.NEXT, key) for key in (*state, *ends)))
    out[keys.IS_EXPERT] = torch.full((len(flat), 1), is_expert, device="cpu")
    if is_expert and label != keys.EXPERT_ACTION and keys.IS_EXPERT in flat:
        out[keys.IS_EXPERT] = flat[keys.IS_EXPERT].clone()
    if label is not None:
        out[keys.EXPERT_ACTION] = flat[label].clone()
    return out
