"""Adam, the schedule of its learning rate and the moving average of the policy."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from pydantic import Field

from ba_torchrl.core.config import StrictModel

if TYPE_CHECKING:
    from torch import nn
    from torch.optim import Adam, Optimizer
    from torch.optim.lr_scheduler import LinearLR

    from ba_torchrl.algorithms.parts.policy_average import PolicyAverage


class OptimizerConfig(StrictModel):
    """Hyper-parameters of the steps along the gradient."""

    learning_rate: float = Field(default=1e-3, gt=0, le=1e3)
    """Learning rate of Adam."""
    learning_rate_end_factor: float = Field(default=1.0, gt=0, le=1)
    """Final fraction of the learning rate, which decreases linearly over the run; constant in the
    reference implementation."""
    weight_decay: float = Field(default=0.0, ge=0)
    """Adam's L2 term on the networks' parameters; none in the reference implementation's SAC."""
    gradient_clamp: float | None = Field(default=None, gt=0)
    """Bound of each element of the networks' gradient; None for no bound, as in the reference
    implementation's SAC."""
    policy_average: float = Field(default=0.0, ge=0, lt=1)
    """Decay of the exponential moving average of the policy's parameters and statistics with which
    the policy acts; 0 for acting with the last ones. None in the appendix."""

    def adam(
        self, parameters: Iterable[nn.Parameter], networks: Iterable[nn.Parameter], factor: float
    ) -> Adam:
        """Return Adam for some parameters.

        Args:
            parameters: these.
            networks: parameters to which weight decay applies, if they are among them.
            factor: on the learning rate.
        """
        from torch.optim import Adam

        others = {id(parameter): parameter for parameter in parameters}
        decayed = [p for p in networks if others.pop(id(p), None) is not None]
        groups = [
            {"params": decayed, "weight_decay": self.weight_decay},
            {"params": list(others.values()), "weight_decay": 0.0},
        ]
        groups = [group for group in groups if group["params"]]
        return Adam(groups, lr=factor * self.learning_rate, fused=True)

    def schedule(self, optimizer: Optimizer, steps: int) -> LinearLR:
        """Return the schedule of an optimiser's learning rate over a number of steps."""
        from torch.optim.lr_scheduler import LinearLR

        end = self.learning_rate_end_factor
        return LinearLR(optimizer, start_factor=1.0, end_factor=end, total_iters=steps)

    def average(self, policy: nn.Module) -> PolicyAverage | None:
        """Return the moving average of a policy, if configured."""
        from ba_torchrl.algorithms.parts.policy_average import PolicyAverage

        if not self.policy_average:
            return None
        return PolicyAverage(policy, self.policy_average)
