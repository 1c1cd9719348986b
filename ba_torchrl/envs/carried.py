"""What a policy carries from one step of an environment to the next."""

from __future__ import annotations

from tensordict import TensorDictBase

from ba_torchrl.core import keys


def state_after(step: TensorDictBase) -> TensorDictBase:
    """Return the state after a step, with the entries under ``carried`` that the policy wrote.

    TorchRL's rollouts and collectors keep them by themselves.

    Args:
        step: what ``env.step`` returns.
    """
    state = step[keys.NEXT]
    return state.set(keys.CARRIED, step[keys.CARRIED]) if keys.CARRIED in step else state
