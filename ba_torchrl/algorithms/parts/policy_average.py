"""The moving average of a policy."""

from __future__ import annotations

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn


class PolicyAverage(AveragedModel):
    """The exponential moving average of a policy's parameters and floating-point buffers.

    Args:
        policy: of which it begins as a copy.
        decay: of the average, at each update.
    """

    def __init__(self, policy: nn.Module, decay: float) -> None:
        super().__init__(policy, multi_avg_fn=get_ema_multi_avg_fn(decay))
        self.decay = decay

    @torch.no_grad()
    def update_parameters(self, model: nn.Module) -> None:
        """Move the average towards a policy of the same structure; the first update copies it."""
        averages = [(each, each.clone()) for each in self.module.buffers()]
        is_first = bool(self.n_averaged == 0)
        super().update_parameters(model)  # which copies buffers
        for buffer, before in averages:
            if buffer.is_floating_point() and not is_first:
                # an equal element stays, since the average of infinities is not a number
                moved = torch.lerp(before, buffer, 1 - self.decay)
                buffer.copy_(torch.where(before == buffer, buffer, moved))
