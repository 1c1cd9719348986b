"""Conversion of rollouts to the transitions that the replay stores."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ba_torchrl.core import keys
from ba_torchrl.core.choices import Imitation
from ba_torchrl.core.errors import check_choice

WITH_TARGET = frozenset({"expert", "expert_everywhere"})
"""Those for which the replay stores ``target_action``."""


def as_transitions(
    tensordict: TensorDictBase,
    images: Iterable[str],
    vectors: Iterable[str] = (),
    *,
    is_demonstration: bool,
    imitates: Imitation = "executed",
    equal_moves: int = 0,
) -> TensorDict:
    """Return the transitions [N] of a rollout with the entries that the replay stores.

    Args:
        tensordict: transitions of any batch shape.
        images: keys of the images to store.
        vectors: keys of the vectors to store.
        is_demonstration: whether they are those of demonstrations.
        imitates: the imitated action, stored as ``target_action`` if it is not the executed one.
        equal_moves: number K of actions [K, A] that are stored as ``target_moves`` beside it, any
            of which is imitated: the expert's equal moves or, where they are not known, the
            imitated action K times. 0 for none.

    Raises:
        KeyError: an entry is missing.
    """
    check_choice("imitates", imitates, Imitation)
    flat = tensordict if tensordict.ndim == 1 else tensordict.reshape(-1)  # [0] has no reshape
    state = [*images, keys.HOLDING, *vectors]
    ends = (keys.REWARD, keys.DONE, keys.TERMINATED, keys.TRUNCATED, keys.FAULT)
    out = flat.select(*state, keys.ACTION, *((keys.NEXT, key) for key in (*state, *ends)))
    out[keys.IS_DEMONSTRATION] = torch.full((len(flat), 1), is_demonstration, device="cpu")
    if imitates in WITH_TARGET:
        is_needed = imitates == "expert_everywhere" and not is_demonstration
        has_expert = is_needed or keys.EXPERT_ACTION in flat
        target = flat[keys.EXPERT_ACTION if has_expert else keys.ACTION].clone()
        out[keys.TARGET_ACTION] = target
        if equal_moves:
            moves = target[:, None].expand(-1, equal_moves, -1)
            known = flat.get(keys.EXPERT_MOVES, None)
            if known is not None and known.shape == moves.shape:  # not of another version's size
                moves = known
            out[keys.TARGET_MOVES] = moves.clone()
    else:
        has_expert = False
    if is_demonstration and imitates != "none" and not has_expert and keys.IS_EXPERT in flat:
        out[keys.IS_DEMONSTRATION] = flat[keys.IS_EXPERT].clone()
    return out


def chunk_windows(
    actions: Tensor, is_known: Tensor, is_executed: Tensor, horizon: int
) -> tuple[Tensor, Tensor]:
    """Return the next actions from each step of an episode, and which of them count.

    Args:
        actions: to imitate in the steps of one episode, [N, A].
        is_known: whether a step has such an action, [N]. From the first step without one, a chunk
            does not count.
        is_executed: whether a step executed its action, [N]. After the first step that did not, a
            chunk does not count: the action does not lead to the states that follow.
        horizon: number T of actions in a chunk.

    Returns:
        [N, T, A], with the episode's last action repeated beyond its end, and bool [N, T].
    """
    index = torch.arange(len(actions), device="cpu")[:, None] + torch.arange(horizon, device="cpu")
    inside = index.clamp(max=len(actions) - 1)
    is_valid = ((index < len(actions)) & is_known[inside]).cumprod(dim=1).bool()
    leads_on = is_executed[inside].cumprod(dim=1).bool()
    is_valid[:, 1:] &= leads_on[:, :-1]
    return actions[inside], is_valid
