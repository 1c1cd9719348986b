"""Eight-bit depth: what the replay stores, and what the acting policy must therefore see."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class DepthQuantizer(nn.Module):
    """Depth images as uint8, in 255 equal steps over [0, high_m].

    As a module it quantises and restores: put it before an acting policy, so that it sees what
    the learner sees. Depth outside the range is clipped; zero, the fingers' value, is exact.

    Args:
        high_m: largest depth, metres.

    Raises:
        ValueError: ``high_m`` is not positive.
    """

    def __init__(self, high_m: float) -> None:
        super().__init__()
        if not high_m > 0:
            raise ValueError(f"high_m must be positive, got {high_m}")
        self.high_m = float(high_m)

    @property
    def step_m(self) -> float:
        """Distance between neighbouring values, metres."""
        return self.high_m / 255

    @property
    def max_error_m(self) -> float:
        """Largest error of a depth within the range: half a step, metres."""
        return self.step_m / 2

    def encode(self, depth: Tensor) -> Tensor:
        """Return uint8 codes of depth in metres, of any shape and floating type.

        Args:
            depth: metres.

        Raises:
            TypeError: the depth is not of a floating type.
        """
        if not depth.is_floating_point():
            raise TypeError(f"depth must be floating point metres, got {depth.dtype}")
        codes = depth.float().clamp(0, self.high_m) * (255 / self.high_m)
        # Not round(): it wakes torch's threads even for one small image, which takes ten
        # milliseconds while environments or updates keep the cores busy.
        return codes.add_(0.5).to(torch.uint8)

    def decode(self, codes: Tensor) -> Tensor:
        """Return float32 metres of uint8 codes of any shape."""
        return codes.to(torch.float32).mul_(self.step_m)

    def forward(self, depth: Tensor) -> Tensor:
        """Return the nearest storable depth, in the type of the input."""
        return self.decode(self.encode(depth)).to(depth.dtype)

    def extra_repr(self) -> str:
        """Return the range for ``print``."""
        return f"high_m={self.high_m}"
