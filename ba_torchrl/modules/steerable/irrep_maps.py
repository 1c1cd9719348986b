"""Fixed linear maps of the neighbourhoods of regular fields, and changes of basis, compiled.

The images of a group, or some rows of one image from the row ``top`` of the result on, lie in one
row of pixels, as `irrep_convolution` describes. A value is the product of a component of a field in
the basis of irreps with one of nine orthonormal patterns of a 3x3 neighbourhood: the centre, then
for the edges and for the corners the mean, two first harmonics and the second harmonic. A map is a
sum of values.
"""

from __future__ import annotations

import numpy as np

from ba_torchrl.core.jit import njit

STRIP = 256
"""Pixels whose values are computed together, so that they stay in the first cache."""

_compiled = njit(nogil=True, fastmath=True)

# Loops over pixels, with unsigned indices and without views of rows: signed indices would have to
# be checked, and each view counts its references atomically.


@_compiled
def _sum(
    target: np.ndarray,
    row: int,
    begin: int,
    sources: np.ndarray,
    first: int,
    length: int,
    factors: np.ndarray,
    columns: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """target[row, begin:] = sum of factors[t] sources[columns[t], first:], start <= t < stop."""
    row, begin, first = np.uintp(row), np.uintp(begin), np.uintp(first)
    if start == stop:
        for i in range(np.uintp(length)):
            target[row, begin + i] = 0
    t = start
    while t < stop:
        a, p = np.uintp(columns[t]), factors[t]
        if stop - t >= 4:
            b, q = np.uintp(columns[t + 1]), factors[t + 1]
            c, r = np.uintp(columns[t + 2]), factors[t + 2]
            d, s = np.uintp(columns[t + 3]), factors[t + 3]
            if t == start:
                for i in range(np.uintp(length)):
                    target[row, begin + i] = (
                        p * sources[a, first + i]
                        + q * sources[b, first + i]
                        + r * sources[c, first + i]
                        + s * sources[d, first + i]
                    )
            else:
                for i in range(np.uintp(length)):
                    target[row, begin + i] += (
                        p * sources[a, first + i]
                        + q * sources[b, first + i]
                        + r * sources[c, first + i]
                        + s * sources[d, first + i]
                    )
            t += 4
        elif stop - t >= 2 and t == start:
            b, q = np.uintp(columns[t + 1]), factors[t + 1]
            for i in range(np.uintp(length)):
                target[row, begin + i] = p * sources[a, first + i] + q * sources[b, first + i]
            t += 2
        elif t == start:
            for i in range(np.uintp(length)):
                target[row, begin + i] = p * sources[a, first + i]
            t += 1
        else:
            for i in range(np.uintp(length)):
                target[row, begin + i] += p * sources[a, first + i]
            t += 1


@_compiled
def _pair(
    target: np.ndarray,
    row: int,
    source: np.ndarray,
    line: int,
    first: int,
    a: int,
    b: int,
    length: int,
    factor: float,
    sign: float,
) -> None:
    """target[row] = factor (source[line, first + a :] + sign source[line, first + b :])."""
    row, line = np.uintp(row), np.uintp(line)
    a, b = np.uintp(first + a), np.uintp(first + b)
    for i in range(np.uintp(length)):
        target[row, i] = factor * (source[line, a + i] + sign * source[line, b + i])


@_compiled
def _quad(
    target: np.ndarray,
    row: int,
    source: np.ndarray,
    line: int,
    first: int,
    a: int,
    b: int,
    c: int,
    d: int,
    length: int,
    factor: float,
    signs: tuple[float, float, float],
) -> None:
    """The same for four neighbours a, b, c and d."""
    row, line = np.uintp(row), np.uintp(line)
    a, b, c, d = np.uintp(first + a), np.uintp(first + b), np.uintp(first + c), np.uintp(first + d)
    p, q, r = factor * signs[0], factor * signs[1], factor * signs[2]
    for i in range(np.uintp(length)):
        target[row, i] = (
            factor * source[line, a + i]
            + p * source[line, b + i]
            + q * source[line, c + i]
            + r * source[line, d + i]
        )


@_compiled
def _shift_add(
    target: np.ndarray,
    row: int,
    source: np.ndarray,
    offsets: tuple[tuple[int, int], ...],
    length: int,
) -> None:
    """target[row] += sum of source[k, offsets[k] :] over four rows k."""
    row = np.uintp(row)
    k, m = np.uintp(offsets[0][0]), np.uintp(offsets[1][0])
    o, q = np.uintp(offsets[2][0]), np.uintp(offsets[3][0])
    a, b = np.uintp(offsets[0][1]), np.uintp(offsets[1][1])
    c, d = np.uintp(offsets[2][1]), np.uintp(offsets[3][1])
    for i in range(np.uintp(length)):
        target[row, i] += source[k, a + i] + source[m, b + i] + source[o, c + i] + source[q, d + i]


@_compiled
def gather_maps(
    fields: np.ndarray,
    change: np.ndarray,
    starts: np.ndarray,
    terms: np.ndarray,
    factors: np.ndarray,
    padding: int,
    top: int,
    maps: np.ndarray,
) -> None:
    """Compute maps [M * F, pixels] of fields [n, F, N, H, W], from the row ``top`` on."""
    count, number, order, rows, columns = fields.shape
    width, pixels = columns + padding, maps.shape[1]
    area, lead = pixels // count, padding * (width + 1) - top * width
    upper, lower = max(0, top - padding), min(rows, top + area // width - padding + 2)
    size = pixels + 2 * width + 2
    raw, planes = np.zeros((order, size), np.float32), np.empty((order, size), np.float32)
    values = np.empty((9 * order, STRIP), np.float32)
    half, root, one = np.float32(0.5), np.float32(np.sqrt(0.5)), np.float32(1)
    matrix, every = change.ravel(), np.arange(order * order) % order
    nw, no, ne, we, ce, ea = 0, 1, 2, width, width + 1, width + 2
    sw, so, se = 2 * width, 2 * width + 1, 2 * width + 2
    for f in range(number):
        for m in range(order):
            for n in range(count):
                for y in range(upper, lower):
                    begin = np.uintp(lead + n * area + y * width)
                    for x in range(np.uintp(columns)):
                        raw[m, begin + x] = fields[n, f, m, y, x]
        for b in range(order):
            _sum(planes, b, 0, raw, 0, size, matrix, every, order * b, order * b + order)
        for at in range(0, pixels, STRIP):
            length = min(STRIP, pixels - at)
            for b in range(order):
                v = 9 * b
                _pair(values, v, planes, b, at, ce, ce, length, one, np.float32(0))
                _quad(values, v + 1, planes, b, at, ea, we, no, so, length, half, (one, one, one))
                _pair(values, v + 2, planes, b, at, ea, we, length, root, -one)
                _pair(values, v + 3, planes, b, at, no, so, length, root, -one)
                _quad(values, v + 4, planes, b, at, ea, we, no, so, length, half, (one, -one, -one))
                _quad(values, v + 5, planes, b, at, ne, sw, nw, se, length, half, (one, one, one))
                _quad(values, v + 6, planes, b, at, ne, sw, nw, se, length, half, (-one, -one, one))
                _quad(values, v + 7, planes, b, at, ne, sw, nw, se, length, half, (-one, one, -one))
                _quad(values, v + 8, planes, b, at, ne, sw, nw, se, length, half, (one, -one, -one))
            for r in range(len(starts) - 1):
                first, last = starts[r], starts[r + 1]
                _sum(maps, r * number + f, at, values, 0, length, factors, terms, first, last)


@_compiled
def scatter_maps(
    maps: np.ndarray,
    change: np.ndarray,
    starts: np.ndarray,
    terms: np.ndarray,
    factors: np.ndarray,
    padding: int,
    top: int,
    fields: np.ndarray,
) -> None:
    """Add the gradient of fields [n, F, N, H, W], from the maps' gradient [M * F, pixels].

    ``starts``, ``terms`` and ``factors`` list the maps of each value.
    """
    count, number, order, rows, columns = fields.shape
    width, pixels = columns + padding, maps.shape[1]
    area, lead = pixels // count, padding * (width + 1) - top * width
    upper, lower = max(0, top - padding), min(rows, top + area // width - padding + 2)
    size, margin = pixels + 2 * width + 2, 2 * width + 2
    raw, planes = np.empty((1, size), np.float32), np.empty((order, size), np.float32)
    values = np.empty((9, pixels), np.float32)
    # The gradient of each neighbour, with zeros before and after it.
    steps = np.zeros((9, pixels + 2 * margin), np.float32)
    half, root = np.float32(0.5), np.float32(np.sqrt(0.5))
    matrix, every = change.T.copy().ravel(), np.arange(order * order) % order
    # Neighbours from northwest to southeast as sums of values.
    begins = np.array([0, 4, 7, 11, 14, 15, 18, 22, 25, 29])
    used = np.array([5, 8, 6, 7, 1, 4, 3, 5, 8, 6, 7, 1, 4, 2, 0])
    used = np.concatenate((used, used[11:14], used[7:11], used[4:7], used[0:4]))
    weights = np.array([1, -1, -1, 1, 1, -1, 0, 1, 1, 1, 1, 1, 1, 0, 2], np.float32) * half
    weights = np.concatenate((weights, weights[11:14], weights[7:11], weights[4:7], weights[0:4]))
    weights[6], weights[13], weights[17], weights[24] = root, -root, root, -root
    weights[20], weights[21], weights[27], weights[28] = -half, -half, half, -half
    for f in range(number):
        for b in range(order):
            for v in range(9):
                first, last = starts[9 * b + v], starts[9 * b + v + 1]
                _sum(values, v, 0, maps, 0, pixels, factors, terms * number + f, first, last)
            for k in range(9):
                _sum(steps, k, margin, values, 0, pixels, weights, used, begins[k], begins[k + 1])
            ce = margin - width - 1
            for i in range(np.uintp(size)):
                planes[b, i] = steps[4, np.uintp(ce) + i]
            near = ((0, margin), (1, margin - 1), (2, margin - 2), (3, margin - width))
            far = (
                (5, margin - width - 2),
                (6, margin - 2 * width),
                (7, margin - 2 * width - 1),
                (8, margin - 2 * width - 2),
            )
            _shift_add(planes, b, steps, near, size)
            _shift_add(planes, b, steps, far, size)
        for m in range(order):
            _sum(raw, 0, 0, planes, 0, size, matrix, every, order * m, order * m + order)
            for n in range(count):
                for y in range(upper, lower):
                    begin = np.uintp(lead + n * area + y * width)
                    for x in range(np.uintp(columns)):
                        fields[n, f, m, y, x] += raw[0, begin + x]


@_compiled
def to_elements(
    out: np.ndarray,
    change: np.ndarray,
    bias: np.ndarray,
    width: int,
    top: int,
    fields: np.ndarray,
) -> None:
    """Change irreps [N * F, pixels] to rows of fields [n, F, N, H, W], and add the bias [F, N]."""
    count, number, order, rows, columns = fields.shape
    pixels = out.shape[1]
    area = pixels // count
    lower = min(rows, top + area // width)
    plane = np.empty((1, pixels), np.float32)
    matrix, every = change.T.copy().ravel(), np.arange(order * order) % order
    for f in range(number):
        places = every * number + f
        for m in range(order):
            _sum(plane, 0, 0, out, 0, pixels, matrix, places, order * m, order * m + order)
            added = bias[f, m]
            for n in range(count):
                for y in range(top, lower):
                    begin = np.uintp(n * area + (y - top) * width)
                    for x in range(np.uintp(columns)):
                        fields[n, f, m, y, x] = plane[0, begin + x] + added


@_compiled
def to_irreps(
    fields: np.ndarray,
    change: np.ndarray,
    width: int,
    top: int,
    out: np.ndarray,
) -> None:
    """Change rows of fields [n, F, N, H, W] to irreps [N * F, pixels], zero beyond each image."""
    count, number, order, rows, columns = fields.shape
    pixels = out.shape[1]
    area = pixels // count
    lower = min(rows, top + area // width)
    planes = np.zeros((order, pixels), np.float32)
    matrix, every = change.ravel(), np.arange(order * order) % order
    for f in range(number):
        for m in range(order):
            for n in range(count):
                for y in range(top, lower):
                    begin = np.uintp(n * area + (y - top) * width)
                    for x in range(np.uintp(columns)):
                        planes[m, begin + x] = fields[n, f, m, y, x]
        for a in range(order):
            first, last = order * a, order * a + order
            _sum(out, a * number + f, 0, planes, 0, pixels, matrix, every, first, last)
