"""Projections of the voxels below a heightmap in the frames of many tool poses, in one batch.

The numbers equal the in-hand mode "proj" (`ba_torchrl.sim.vision.in_hand`), for all poses of
a deictic encoding at once and on any device. A device without float64 computes in float32; there,
voxels close to halfway between two cells can belong to the other one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ba_torchrl.modules.layers import cached_constant, widened

TIE_TOLERANCE = 1e-9
"""Voxels. A rotated voxel centre this close to halfway between two cells belongs to the upper
one."""


def tool_rotations(rz_rad: Tensor, ry_rad: Tensor, rx_rad: Tensor) -> Tensor:
    """Return the matrices Rz(rz) Ry(ry) Rx(rx), float64 [..., 3, 3], of angles [...]."""
    rz, ry, rx = torch.broadcast_tensors(widened(rz_rad), widened(ry_rad), widened(rx_rad))
    cz, sz, cy, sy, cx, sx = rz.cos(), rz.sin(), ry.cos(), ry.sin(), rx.cos(), rx.sin()
    rows = [
        torch.stack([cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx], dim=-1),
        torch.stack([sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx], dim=-1),
        torch.stack([-sy, cy * sx, cy * cx], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def rotated_cells(rotations: Tensor, size: int) -> Tensor:
    """Return the cell of the tool frame that each voxel of a cube is rotated into.

    Voxels are rotated about the centre of the cube, in the reference implementation about the voxel
    of index size / 2.

    Args:
        rotations: float64 [N, 3, 3] of the tool frames.
        size: voxels along an edge.

    Returns:
        int32 [N, size, size, size], one plus the index into the flattened cells; zero for voxels
        that are rotated out of the cube.
    """
    offset = torch.arange(size, dtype=rotations.dtype, device=rotations.device) - (size - 1) / 2
    cells = torch.zeros((len(rotations), size, size, size), dtype=torch.int32, device=offset.device)
    is_inside = torch.ones_like(cells, dtype=torch.bool)
    for axis in range(3):
        x, y, z = (rotations[:, i, axis, None] * offset for i in range(3))
        # summed in the order of the compiled kernel of the in-hand image
        index = _nearest_cell((x[:, :, None] + y[:, None])[..., None] + z[:, None, None], size)
        is_inside &= (index >= 0) & (index < size)
        cells = cells * size + index
    return torch.where(is_inside, cells + 1, 0)


def _nearest_cell(offset: Tensor, size: int) -> Tensor:
    """Return int32 indices of the cells nearest to offsets from the centre, in voxels."""
    return (offset + (size - 1) / 2 + 0.5 + TIE_TOLERANCE).floor_().int()


@cached_constant(maxsize=8)
def cell_table(
    yaws_rad: tuple[float, ...],
    ry_rad: tuple[float, ...],
    rx_rad: tuple[float, ...],
    size: int,
    device: torch.device,
) -> Tensor:
    """Return the `rotated_cells` of every combination of angles, computed once per process.

    Returns:
        int32 [yaws, ry, rx, size, size, size]: 43 MB for 16 x 7 x 7 rotations of 24 voxels, 200 MB
        for 40 voxels. With both orders of the fingers, a process holds twice this.
    """
    angles = (torch.tensor(values, dtype=torch.float64) for values in (yaws_rad, ry_rad, rx_rad))
    rotations = tool_rotations(*torch.meshgrid(*angles, indexing="ij"))
    # one yaw at a time bounds the memory of the computation
    return (
        torch.stack([rotated_cells(r.flatten(0, 1), size) for r in rotations])
        .unflatten(1, rotations.shape[1:3])
        .to(device)
    )


def column_counts(heights: Tensor, z_m: Tensor, pixel_m: float, size: int) -> Tensor:
    """Return the number of voxels below the heights of a patch, in each column of a cube.

    Args:
        heights: float64 [B, n], metres.
        z_m: float64 [B, K], heights of the centres of K cubes.
        pixel_m: edge of a voxel.
        size: voxels along an edge.

    Returns:
        int64 [B, K, n], 0 to ``size``.
    """
    offset = torch.arange(size, dtype=heights.dtype, device=heights.device) - (size - 1) / 2
    levels = z_m[..., None] + offset * pixel_m
    values = heights[:, None].expand(*z_m.shape, -1).contiguous()
    return torch.searchsorted(levels, values)


def project(patches: Tensor, pixel_m: float, z_m: Tensor, cells: Tensor) -> Tensor:
    """Return the numbers of occupied voxels along the three axes of each tool frame.

    A voxel is occupied if it is below the height of its pixel. Occupied voxels are rotated into the
    nearest cells of the tool frame, which a median filter of 2 x 2 x 2 cells smooths.

    Args:
        patches: heights around the tool points [B, p, p], metres, in the axes of the scene.
        pixel_m: edge of a pixel and a voxel.
        z_m: heights of the tool points [B, K].
        cells: int32 [B, K, p, p, p] of the tools' rotations, see `rotated_cells`.

    Returns:
        float32 [B, K, 3, p, p]: sums along the x, y and z axes.
    """
    batch, count = z_m.shape
    size = patches.shape[-1]
    heights = _rounded(patches).flatten(1)
    below = column_counts(heights, widened(z_m), pixel_m, size).flatten(0, 1)
    level = torch.arange(size, device=patches.device)
    is_occupied = level < below[..., None]
    # cell 0 collects the free voxels, and those that are rotated out of the cube
    index = cells.reshape(batch * count, -1) * is_occupied.flatten(1)
    voxels = torch.zeros((batch * count, size**3 + 1), dtype=torch.uint8, device=patches.device)
    voxels = voxels.scatter_(1, index.long(), 1)[:, 1:].unflatten(1, (size, size, size))
    for axis in (1, 2, 3):  # the border is replicated
        before = torch.cat([voxels.narrow(axis, 0, 1), voxels.narrow(axis, 0, size - 1)], axis)
        voxels = voxels + before
    smooth = (voxels >= 4).float()
    return torch.stack([smooth.sum(axis) for axis in (1, 2, 3)], dim=1).unflatten(0, (batch, count))


def project_upright(patches: Tensor, pixel_m: float, z_m: Tensor, rz_rad: Tensor) -> Tensor:
    """Return the projections of tools without tilts, with yaws [B], as `project` does.

    The occupied voxels of a column are then those below a height, before and after the rotation and
    the median filter, so no voxels are needed. Other arguments and the result are as in
    `project`.
    """
    size = patches.shape[-1]
    below = column_counts(_turned(_rounded(patches), rz_rad), widened(z_m), pixel_m, size)
    columns = _filtered_columns(below.unflatten(-1, (size, size)))
    return torch.stack(
        [_occupied(columns, dim=-2), _occupied(columns, dim=-1), columns.float()], dim=2
    )


def _rounded(patches: Tensor) -> Tensor:
    return widened(patches).round(decimals=5)


def _turned(patches: Tensor, rz_rad: Tensor) -> Tensor:
    """Return the greatest height that is rotated into each column, float64 [B, p * p].

    Columns that no column is rotated into have a height of minus infinity.
    """
    size = patches.shape[-1]
    offset = torch.arange(size, dtype=patches.dtype, device=patches.device) - (size - 1) / 2
    yaw = widened(rz_rad)
    cos, sin = (part[:, None, None] for part in (yaw.cos(), yaw.sin()))
    row = _nearest_cell(cos * offset[:, None] + sin * offset, size)
    column = _nearest_cell(cos * offset - sin * offset[:, None], size)
    is_inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
    index = torch.where(is_inside, row * size + column + 1, 0).flatten(1).long()
    highest = torch.full(
        (len(patches), size**2 + 1), -torch.inf, dtype=patches.dtype, device=patches.device
    )
    return highest.scatter_reduce(1, index, patches.flatten(1), "amax")[:, 1:]


def _filtered_columns(below: Tensor) -> Tensor:
    """Return the median filter of columns of occupied voxels, int64 [..., p, p] of [..., p, p].

    A voxel is occupied if four of the eight voxels of its kernel are: those of its level and the
    level below (at level 0: itself) in four columns. With the occupied numbers a >= b >= c >= d of
    those columns, these are the levels below b, and level b itself where two more voxels of the
    level below are occupied.
    """
    size = below.shape[-1]
    for_each = [below]
    for dim in (-2, -1):
        for_each += [
            torch.cat([n.narrow(dim, 0, 1), n.narrow(dim, 0, size - 1)], dim) for n in for_each
        ]
    (low, high), (other_low, other_high) = (
        (torch.minimum(m, n), torch.maximum(m, n)) for m, n in (for_each[:2], for_each[2:])
    )
    a, d = torch.maximum(high, other_high), torch.minimum(low, other_low)
    second, third = torch.minimum(high, other_high), torch.maximum(low, other_low)
    b, c = torch.maximum(second, third), torch.minimum(second, third)
    reaches_b = (b > 0) & torch.where(a > b, c == b, d == b)
    return (b + reaches_b).clamp_max(size)


def _occupied(columns: Tensor, dim: int) -> Tensor:
    """Return how many columns [..., p, p] along a dimension are occupied at each level.

    Returns:
        float32 [..., p, p], the remaining dimension and the level.
    """
    size = columns.shape[-1]
    along = columns if dim == -1 else columns.transpose(-2, -1)
    histogram = torch.zeros(*along.shape[:-1], size + 1, dtype=torch.float32, device=along.device)
    histogram.scatter_add_(-1, along, torch.ones_like(along, dtype=torch.float32))
    # level k is occupied in the columns that have more than k voxels
    return histogram.flip(-1).cumsum(-1).flip(-1)[..., 1:]
