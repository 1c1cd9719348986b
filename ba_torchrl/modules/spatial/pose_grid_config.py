"""Hyper-parameters of the levels of z and the tilts."""

from __future__ import annotations

import math

from pydantic import Field

from ba_torchrl.core.config import StrictModel


class PoseGridConfig(StrictModel):
    """Hyper-parameters of the levels of z and the tilts; the defaults are from the
    reference implementation; the appendix gives none.

    Args:
        num_z: heights of the tool, evenly spaced.
        min_z_m: least height.
        max_z_m: greatest height.
        num_tilts: values of ry, and of rx, evenly spaced.
        max_tilt_rad: greatest tilt; the least is its negative.
    """

    num_z: int = Field(default=36, ge=2, le=1000)
    min_z_m: float = 0.02
    max_z_m: float = 0.20
    num_tilts: int = Field(default=7, ge=2, le=100)
    max_tilt_rad: float = Field(default=math.pi / 8, gt=0)

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """First and last value on the grids of z and the tilts."""
        tilts = (-self.max_tilt_rad, self.max_tilt_rad)
        return {"z": (self.min_z_m, self.max_z_m), "ry": tilts, "rx": tilts}
