"""A contrastive loss of the encoder on pairs of views (CURL, FERM)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from ba_torchrl.core.config import Part

if TYPE_CHECKING:
    from torch import nn

    from ba_torchrl.core.images import ImageSpec
    from ba_torchrl.objectives.sacfd import BilinearInfoNCE


class NoContrastive(Part):
    """The encoder learns from the critics alone."""

    name: Literal["none"] = "none"
    updates: ClassVar[int] = 0

    def build(self, encoder: nn.Module, images: Mapping[str, ImageSpec]) -> None:
        """Return no loss."""


class InfoNCE(Part):
    """The encoder's features tell views of an image from those of others."""

    name: Literal["info_nce"] = "info_nce"
    weight: float = Field(default=1.0, gt=0)
    """Factor on the learning rate of the loss's two optimisers. Adam's steps do not depend on a
    factor on the loss. 1 is the reference implementation's; the appendix gives none."""
    updates: int = Field(default=0, ge=0)
    """First updates of a run, on the demonstrations, that minimise this loss instead of the others,
    together with that of `init` while there is one. `pretrain_updates` does not count them."""

    def build(self, encoder: nn.Module, images: Mapping[str, ImageSpec]) -> BilinearInfoNCE:
        """Return the loss of features.

        Args:
            encoder: of the features.
            images: declarations of its images.
        """
        import torch

        from ba_torchrl.core.evaluation_mode import evaluation_copy
        from ba_torchrl.objectives.sacfd import BilinearInfoNCE

        device = next(encoder.parameters()).device
        zeros = [torch.zeros(image.shape, device=device) for image in images.values()]
        with torch.no_grad():  # without vectors, which are not compared
            features = evaluation_copy(encoder)(*zeros, torch.zeros(1, device=device))
        return BilinearInfoNCE(features.shape[-1])


Contrastive = Annotated[NoContrastive | InfoNCE, Field(discriminator="name")]
