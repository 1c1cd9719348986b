"""Groups of images, or of rows of an image, whose maps fit the second cache."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

CHUNK_BYTES = 1_500_000
"""Largest size of the maps of a group, so that they stay in the second cache."""
LEAST_ROWS = 16
"""Least rows of an image in a group: the rows beside them are read twice."""


class Chunk(NamedTuple):
    """A group of images, or some rows of one image.

    Args:
        images: the images.
        top: first row of the result.
        maps: uninitialised, [M, F, pixels].
        out: uninitialised, [N, out, pixels].
    """

    images: slice
    top: int
    maps: Tensor
    out: Tensor


class Layout:
    """How images lie in one row of pixels, with zeros between them.

    A column of zeros ends each row of an image, and a row of zeros each image, if the convolution
    is padded: one is enough for both neighbours. Images whose maps are too large for the cache are
    computed in groups of rows.

    Args:
        shape: [B, in * N, H, W] of the input.
        maps: number of maps of a field.
        order: number of group elements, N.
        padding: zeros added on each side, pixels.
    """

    def __init__(self, shape: Sequence[int], maps: int, order: int, padding: int) -> None:
        self.maps, self.order = maps, order
        self.fields = shape[1] // order
        self.output = tuple(size + 2 * padding - 2 for size in shape[2:])
        self.rows, self.width = (size + padding for size in shape[2:])

    def chunks(self, part: slice, out_fields: int) -> Iterator[Chunk]:
        """Iterate over the images of a part; the next chunk uses the same memory.

        Args:
            part: images of the batch.
            out_fields: number of output fields.
        """
        rows_that_fit = CHUNK_BYTES // (4 * self.maps * self.fields * self.width)
        step, rows, tops = max(1, rows_that_fit // self.rows), self.rows, [0]
        groups = self.output[0] // max(LEAST_ROWS, rows_that_fit)
        if groups > 1:
            rows = math.ceil(self.output[0] / groups)
            tops = list(range(0, self.output[0], rows))
        shapes = (self.maps, self.fields), (self.order, out_fields)
        memory = [
            torch.empty(
                math.prod(shape) * step * rows * self.width, dtype=torch.float32, device="cpu"
            )
            for shape in shapes
        ]
        for start in range(part.start, part.stop, step):
            images = slice(start, min(start + step, part.stop))
            for top in tops:
                pixels = (images.stop - start) * min(rows, self.rows - top) * self.width
                sizes = [(*shape, pixels) for shape in shapes]
                maps, out = (
                    values[: math.prod(size)].view(size)
                    for values, size in zip(memory, sizes, strict=True)
                )
                yield Chunk(images, top, maps, out)
