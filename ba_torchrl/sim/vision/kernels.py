"""Compiled kernels of the depth cameras: triangles, floor and points into z-buffers.

Every pixel stands for its centre. Faces are counter-clockwise seen from outside; those turned away
are left out. The kernels are cached on disk and loaded when first called, one by one.
"""

# ruff: noqa: ANN001, ANN201, ANN202 -- compiled functions

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True)
def transform(vertices, owner, poses, out):
    """Move each vertex by the pose (x, y, z, qx, qy, qz, qw) of its body."""
    for v in range(vertices.shape[0]):
        x, y, z, qx, qy, qz, qw = poses[owner[v]]
        a, b, c = vertices[v]
        # t = 2 q x v; v' = v + w t + q x t
        tx, ty, tz = 2 * (qy * c - qz * b), 2 * (qz * a - qx * c), 2 * (qx * b - qy * a)
        out[v, 0] = x + a + qw * tx + qy * tz - qz * ty
        out[v, 1] = y + b + qw * ty + qz * tx - qx * tz
        out[v, 2] = z + c + qw * tz + qx * ty - qy * tx


@numba.njit(cache=True)
def rotate_about(vertices, x0, y0, yaw):
    """Turn the vertices in place about the vertical through (x0, y0)."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    for v in range(vertices.shape[0]):
        dx, dy = vertices[v, 0] - x0, vertices[v, 1] - y0
        vertices[v, 0] = x0 + cos * dx - sin * dy
        vertices[v, 1] = y0 + sin * dx + cos * dy


@numba.njit(cache=True)
def rasterize_heights(vertices, faces, x0, y0, pixel, image):
    """Raise ``image`` to the height of the upward faces, seen from straight above."""
    rows, cols = image.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f]
        ax, ay = (vertices[a, 0] - x0) / pixel - 0.5, (vertices[a, 1] - y0) / pixel - 0.5
        bx, by = (vertices[b, 0] - x0) / pixel - 0.5, (vertices[b, 1] - y0) / pixel - 0.5
        cx, cy = (vertices[c, 0] - x0) / pixel - 0.5, (vertices[c, 1] - y0) / pixel - 0.5
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area <= 1e-12:
            continue  # faces down or is edge-on
        i0 = max(0, math.ceil(min(ax, bx, cx)))
        i1 = min(rows - 1, math.floor(max(ax, bx, cx)))
        j0 = max(0, math.ceil(min(ay, by, cy)))
        j1 = min(cols - 1, math.floor(max(ay, by, cy)))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                u = ((i - ax) * (cy - ay) - (cx - ax) * (j - ay)) / area
                v = ((bx - ax) * (j - ay) - (i - ax) * (by - ay)) / area
                if u >= -1e-9 and v >= -1e-9 and u + v <= 1 + 1e-9:
                    height = (
                        vertices[a, 2]
                        + u * (vertices[b, 2] - vertices[a, 2])
                        + v * (vertices[c, 2] - vertices[a, 2])
                    )
                    image[i, j] = max(image[i, j], height)


@numba.njit(cache=True)
def paint_square(
    image: np.ndarray,
    center_px: tuple[float, float],
    half_px: float,
    yaw_rad: float,
    value: float,
) -> None:
    """Set the pixels whose centres lie in a rotated square.

    Args:
        image: [H, W], changed in place.
        center_px: row and column of the square's centre; pixel (i, j) has its at (i+1/2, j+1/2).
        half_px: half the square's edge.
        yaw_rad: turn from rows towards columns.
        value: what to write.
    """
    reach = half_px * math.sqrt(2)
    x, y = center_px
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    limit = half_px + 1e-9
    for i in range(max(0, math.floor(x - reach)), min(image.shape[0], math.ceil(x + reach))):
        for j in range(max(0, math.floor(y - reach)), min(image.shape[1], math.ceil(y + reach))):
            di, dj = i + 0.5 - x, j + 0.5 - y
            if abs(cos * di + sin * dj) <= limit and abs(cos * dj - sin * di) <= limit:
                image[i, j] = value


@numba.njit(cache=True)
def recess_depth_at(x, y, recesses):
    """Return how deep the floor dips at a point; a dip is x, y, half edge, cos, sin, depth."""
    depth = 0.0
    for d in range(recesses.shape[0]):
        dx, dy = x - recesses[d, 0], y - recesses[d, 1]
        cos, sin, limit = recesses[d, 3], recesses[d, 4], recesses[d, 2] + 1e-9
        if abs(cos * dx + sin * dy) <= limit and abs(cos * dy - sin * dx) <= limit:
            depth = recesses[d, 5]
    return depth


@numba.njit(cache=True)
def rasterize_floor(eye, axes, focal, far, recesses, depth):
    """Fill ``depth`` with the floor's; the rows of ``axes`` point down, right and forward.

    Through a dip one looks on to a floor that much lower.
    """
    rows, cols = depth.shape
    for i in range(rows):
        p = (i + 0.5 - rows / 2) / focal
        for j in range(cols):
            q = (j + 0.5 - cols / 2) / focal
            fall = -(axes[2, 2] + p * axes[0, 2] + q * axes[1, 2])
            reach = eye[2] / fall if fall > 1e-9 else far
            if reach < far:
                x = eye[0] + reach * (axes[2, 0] + p * axes[0, 0] + q * axes[1, 0])
                y = eye[1] + reach * (axes[2, 1] + p * axes[0, 1] + q * axes[1, 1])
                reach += recess_depth_at(x, y, recesses) / fall
            depth[i, j] = min(reach, far)


@numba.njit(cache=True)
def _rasterize_triangle(ap, aq, ad, bp, bq, bd, cp, cq, cd, depth):
    """Lower ``depth`` to a triangle given by row, column and depth of its corners."""
    area = (bp - ap) * (cq - aq) - (cp - ap) * (bq - aq)
    if area <= 1e-12:
        return  # turned away or edge-on
    rows, cols = depth.shape
    i0, i1 = max(0, math.ceil(min(ap, bp, cp))), min(rows - 1, math.floor(max(ap, bp, cp)))
    j0, j1 = max(0, math.ceil(min(aq, bq, cq))), min(cols - 1, math.floor(max(aq, bq, cq)))
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            u = ((i - ap) * (cq - aq) - (cp - ap) * (j - aq)) / area
            v = ((bp - ap) * (j - aq) - (i - ap) * (bq - aq)) / area
            if u >= -1e-9 and v >= -1e-9 and u + v <= 1 + 1e-9:
                # in the image, 1 / depth is linear and depth is not
                inverse = (1 - u - v) / ad + u / bd + v / cd
                depth[i, j] = min(depth[i, j], 1 / inverse)


@numba.njit(cache=True)
def rasterize_depth(vertices, faces, eye, axes, focal, near, depth):
    """Lower ``depth`` to the faces seen in perspective; what is nearer than ``near`` is cut off."""
    rows, cols = depth.shape
    seen = np.empty_like(vertices)  # along the image's rows, its columns, and in depth
    for v in range(vertices.shape[0]):
        x, y, z = vertices[v, 0] - eye[0], vertices[v, 1] - eye[1], vertices[v, 2] - eye[2]
        for k in range(3):
            seen[v, k] = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z
    corner = np.empty((4, 3))  # a triangle without a corner has at most four
    for f in range(faces.shape[0]):
        count = 0
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            da, db = seen[a, 2], seen[b, 2]
            if da >= near:
                corner[count] = seen[a]
                count += 1
            if (da >= near) != (db >= near):
                share = (near - da) / (db - da)
                for m in range(3):
                    corner[count, m] = seen[a, m] + share * (seen[b, m] - seen[a, m])
                count += 1
        for k in range(count):
            scale = focal / corner[k, 2]
            corner[k, 0] = corner[k, 0] * scale + rows / 2 - 0.5
            corner[k, 1] = corner[k, 1] * scale + cols / 2 - 0.5
        for k in range(1, count - 1):
            a0, a1, a2 = corner[0]
            b0, b1, b2 = corner[k]
            c0, c1, c2 = corner[k + 1]
            _rasterize_triangle(a0, a1, a2, b0, b1, b2, c0, c1, c2, depth)


@numba.njit(cache=True)
def unproject(depth, eye, axes, focal, recesses, low, high, out, start):
    """Write the points that the pixels show, if inside a box, into ``out`` from ``start`` on.

    Points of the floor inside a dip are sunk by its depth, straight down. Returns the end.
    """
    rows, cols = depth.shape
    count = start
    for i in range(rows):
        p = (i + 0.5 - rows / 2) / focal
        for j in range(cols):
            q = (j + 0.5 - cols / 2) / focal
            t = depth[i, j]
            x = eye[0] + t * (axes[2, 0] + p * axes[0, 0] + q * axes[1, 0])
            y = eye[1] + t * (axes[2, 1] + p * axes[0, 1] + q * axes[1, 1])
            z = eye[2] + t * (axes[2, 2] + p * axes[0, 2] + q * axes[1, 2])
            if z < 1e-9:
                z -= recess_depth_at(x, y, recesses)
            if low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] - 1e-9 <= z <= high[2]:
                out[count, 0], out[count, 1], out[count, 2] = x, y, z
                count += 1
    return count


@numba.njit(cache=True)
def splat(points, count, x0, y0, pixel, image):
    """Return the greatest height of the points in each pixel; pixels without one copy the nearest.

    Where there is no point at all the image stays as it is.
    """
    rows, cols = image.shape
    seen = np.full((rows, cols), -np.inf)
    for n in range(count):
        i, j = math.floor((points[n, 0] - x0) / pixel), math.floor((points[n, 1] - y0) / pixel)
        if 0 <= i < rows and 0 <= j < cols:
            seen[i, j] = max(seen[i, j], points[n, 2])
    # in each row, the nearest column with a point
    column = np.full((rows, cols), -1)
    for i in range(rows):
        last = -1
        for j in range(cols):
            if seen[i, j] > -np.inf:
                last = j
            column[i, j] = last
        last = -1
        for j in range(cols - 1, -1, -1):
            if seen[i, j] > -np.inf:
                last = j
            if last >= 0 and (column[i, j] < 0 or last - j < j - column[i, j]):
                column[i, j] = last
    for i in range(rows):
        for j in range(cols):
            best = rows * rows + cols * cols
            for r in range(rows):
                if r * r >= best:
                    break
                for k in (i - r, i + r):
                    if 0 <= k < rows and column[k, j] >= 0:
                        distance = r * r + (column[k, j] - j) ** 2
                        if distance < best:
                            best = distance
                            image[i, j] = seen[k, column[k, j]]
