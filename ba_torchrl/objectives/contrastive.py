"""The contrastive loss of image encoders (CURL; FERM, appendix G.2)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class BilinearInfoNCE(nn.Module):
    """InfoNCE with a learnt bilinear similarity (CURL: Srinivas et al., 2020, section 4).

    The similarity of anchor i and positive j is a_i W p_j. The loss of anchor i is the
    cross-entropy of these similarities over all positives of the batch with the label i.

    Args:
        features: size of the encoder's features.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.rand(features, features))

    def forward(self, anchors: Tensor, positives: Tensor) -> Tensor:
        """Return the losses [B] of anchors [B, F] and their positives [B, F]."""
        similarities = anchors @ self.weight @ positives.mT
        labels = torch.arange(len(anchors), device=anchors.device)
        return F.cross_entropy(similarities, labels, reduction="none")
