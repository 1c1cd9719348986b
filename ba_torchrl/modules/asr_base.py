"""Augmented state representation: a pixel, then one component of the pose after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from pydantic import Field
from torch import Tensor, nn

from ba_torchrl.modules.patches import patches
from ba_torchrl.modules.spatial import Level, SpatialQNetwork, SpatialSpec
from ba_torchrl.modules.spatial_inputs import SpatialImageConfig, require_unet_size

View = Callable[[Tensor, Tensor], Tensor]
"""From heightmaps [B, 1, H, W] and the indices chosen so far [B, n] to what a later level sees."""


class ASRState(NamedTuple):
    """Inputs of the later levels besides the choices: the images and the first level's features."""

    pixels: Tensor
    in_hand: Tensor
    holding: Tensor
    scene: Tensor


class ASR(SpatialQNetwork):
    """Levels of choices: all pixels, then the values of one component at the chosen pixel each.

    All levels share the first level's feature map, so the losses of the later levels also train the
    first level's encoder.

    Args:
        positions: (pixels, in_hand, holding) -> (values [B, 1, H, W], scene feature map).
        later: for each later level, its view of the heightmap around the chosen pixel, and its
            head: (view, in_hand, scene feature map, holding) -> values [B, n].
        levels: pixels, then one component each.
        limits: first and last value on the grids of z and the tilts.
    """

    def __init__(
        self,
        positions: nn.Module,
        later: Sequence[tuple[View, nn.Module]],
        levels: Sequence[Level],
        limits: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        super().__init__()
        self.positions = positions
        self.views = tuple(view for view, _ in later)
        self.heads = nn.ModuleList(head for _, head in later)
        self.levels = tuple(levels)
        self.limits = dict(limits or {})

    def first(self, pixels: Tensor, in_hand: Tensor, holding: Tensor) -> tuple[Tensor, ASRState]:
        """Return the Q values [B, H, W] of the pixels, and the state for `later`."""
        values, scene = self.positions(pixels, in_hand, holding)
        return values.squeeze(1), ASRState(pixels, in_hand, holding, scene)

    def later(self, level: int, state: Any, chosen: Tensor) -> Tensor:
        """Return the Q values [B, n] of a component, given the choices [B, m] before it.

        Raises:
            ValueError: there is no such level.
        """
        if not 1 <= level < len(self.levels):
            raise ValueError(
                f"the later levels of this network are 1 to {len(self.levels) - 1}, got {level}"
            )
        view = self.views[level - 1](state.pixels, chosen)
        return self.heads[level - 1](view, state.in_hand, state.scene, state.holding)


@dataclass(frozen=True)
class PatchView:
    """Heights around the chosen pixel.

    Args:
        size: rows and columns of the patch.
    """

    size: int

    def __call__(self, pixels: Tensor, chosen: Tensor) -> Tensor:
        """Return patches [B, 1, p, p], metres."""
        return patches(pixels, chosen[:, :2], self.size)


class ASRNetworkConfig(SpatialImageConfig):
    """Hyper-parameters of every ASR network.

    Args:
        num_rotations: yaws, evenly spaced; the default is that of the reference implementation.
        patch_size: rows and columns of the patch around a pixel that the later levels see; None for
            the size of the in-hand image (in the paper 24, and 40 on bumps). If the two sizes
            differ, the in-hand image is cropped or zero-padded to the patch size about its centre.
    """

    num_rotations: int = Field(default=16, ge=2)
    patch_size: int | None = Field(default=None, ge=1)

    def _planar_layout(self, name: str, spec: SpatialSpec) -> tuple[tuple[Level, Level], int]:
        """Return the levels of pixels and yaws, and the patch's size.

        Raises:
            ValueError: a size does not fit.
        """
        require_unet_size(name, spec.image_size)
        patch_size = self.patch_size or spec.in_hand_size
        if (patch_size - spec.in_hand_size) % 2:
            raise ValueError(
                f"patch_size and in_hand_size must share a centre, so differ by an even number of "
                f"pixels; got {patch_size} and {spec.in_hand_size}"
            )
        pixels = Level(("x", "y"), (spec.image_size, spec.image_size))
        return (pixels, Level(("rz",), (self.num_rotations,))), patch_size
