"""Compiled kernels that rasterise triangles, the floor and points, and project voxels.

Pixels are sampled at their centres. Faces are counter-clockwise seen from outside; back faces are
culled. Coordinates are in metres, and images [H, W] are modified in place. A perspective camera has
its position ``eye`` [3], the directions of the image rows, of the image columns and of the view as
rows of ``axes`` [3, 3], and a focal length in pixels. Numba caches each kernel on disk and loads it
at its first call.
"""

# ruff: noqa: ANN001, ANN201, ANN202 -- compiled functions

from __future__ import annotations

import math

import numpy as np

from ba_torchrl.core.jit import njit

TIE_TOLERANCE = 1e-9
"""Voxels. A rotated voxel centre this close to halfway between two cells belongs to the upper one,
so that rounding errors of the rotation do not decide."""


@njit()
def transform(vertices, owner, poses, out):
    """Transform vertices [V, 3] from the frames of their bodies into the world frame.

    ``owner`` [V] has the index of each vertex's body, ``poses`` [B, 7] position and quaternion.
    """
    for v in range(vertices.shape[0]):
        x, y, z, qx, qy, qz, qw = poses[owner[v]]
        a, b, c = vertices[v]
        # t = 2 q x v; v' = v + w t + q x t
        tx, ty, tz = 2 * (qy * c - qz * b), 2 * (qz * a - qx * c), 2 * (qx * b - qy * a)
        out[v, 0] = x + a + qw * tx + qy * tz - qz * ty
        out[v, 1] = y + b + qw * ty + qz * tx - qx * tz
        out[v, 2] = z + c + qw * tz + qx * ty - qy * tx


@njit()
def rotate_about(vertices, x0, y0, yaw):
    """Rotate the vertices in place about the vertical line through (x0, y0)."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    for v in range(vertices.shape[0]):
        dx, dy = vertices[v, 0] - x0, vertices[v, 1] - y0
        vertices[v, 0] = x0 + cos * dx - sin * dy
        vertices[v, 1] = y0 + sin * dx + cos * dy


@njit()
def rasterize_heights(vertices, faces, x0, y0, pixel, image):
    """Rasterise faces into an orthographic height image: the maximum of old and new heights.

    The outer corner of pixel (0, 0) is at (x0, y0); ``pixel`` is the edge of a pixel.
    """
    rows, cols = image.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f]
        ax, ay = (vertices[a, 0] - x0) / pixel - 0.5, (vertices[a, 1] - y0) / pixel - 0.5
        bx, by = (vertices[b, 0] - x0) / pixel - 0.5, (vertices[b, 1] - y0) / pixel - 0.5
        cx, cy = (vertices[c, 0] - x0) / pixel - 0.5, (vertices[c, 1] - y0) / pixel - 0.5
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area <= 1e-12:
            continue  # back face or edge-on
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


@njit()
def paint_square(
    image: np.ndarray, center_px: tuple[float, float], half_px: float, yaw_rad: float, value: float
) -> None:
    """Set the pixels whose centres lie in a rotated square.

    The square's centre has a row and a column; pixel (i, j) has its centre at (i+1/2, j+1/2). The
    rotation is from rows towards columns.
    """
    half_diagonal = half_px * math.sqrt(2)
    x, y = center_px
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    limit = half_px + 1e-9
    for i in range(
        max(0, math.floor(x - half_diagonal)), min(image.shape[0], math.ceil(x + half_diagonal))
    ):
        for j in range(
            max(0, math.floor(y - half_diagonal)), min(image.shape[1], math.ceil(y + half_diagonal))
        ):
            di, dj = i + 0.5 - x, j + 0.5 - y
            if abs(cos * di + sin * dj) <= limit and abs(cos * dj - sin * di) <= limit:
                image[i, j] = value


@njit()
def recess_depth_at(x, y, recesses):
    """Return the depth of the floor's recess at a point; 0 outside of recesses.

    A row of ``recesses`` [R, 6] has x, y, half edge, cos and sin of the yaw, and depth of a square.
    """
    depth = 0.0
    for d in range(recesses.shape[0]):
        dx, dy = x - recesses[d, 0], y - recesses[d, 1]
        cos, sin, limit = recesses[d, 3], recesses[d, 4], recesses[d, 2] + 1e-9
        if abs(cos * dx + sin * dy) <= limit and abs(cos * dy - sin * dx) <= limit:
            depth = recesses[d, 5]
    return depth


@njit()
def rasterize_floor(eye, axes, focal, far, recesses, depth):
    """Set a perspective depth image to the depth of the floor.

    A ray that hits the floor inside a recess continues to the plane at the bottom of the recess.
    """
    rows, cols = depth.shape
    for i in range(rows):
        p = (i + 0.5 - rows / 2) / focal
        for j in range(cols):
            q = (j + 0.5 - cols / 2) / focal
            descent = -(axes[2, 2] + p * axes[0, 2] + q * axes[1, 2])
            t = eye[2] / descent if descent > 1e-9 else far
            if t < far:
                x = eye[0] + t * (axes[2, 0] + p * axes[0, 0] + q * axes[1, 0])
                y = eye[1] + t * (axes[2, 1] + p * axes[0, 1] + q * axes[1, 1])
                t += recess_depth_at(x, y, recesses) / descent
            depth[i, j] = min(t, far)


@njit()
def _rasterize_triangle(ap, aq, ad, bp, bq, bd, cp, cq, cd, depth):
    """Rasterise a triangle into a depth image: the minimum of old and new depths.

    Each of the corners a, b and c has a row p and a column q (pixels) and a depth d (metres).
    """
    area = (bp - ap) * (cq - aq) - (cp - ap) * (bq - aq)
    if area <= 1e-12:
        return  # back face or edge-on
    rows, cols = depth.shape
    i0, i1 = max(0, math.ceil(min(ap, bp, cp))), min(rows - 1, math.floor(max(ap, bp, cp)))
    j0, j1 = max(0, math.ceil(min(aq, bq, cq))), min(cols - 1, math.floor(max(aq, bq, cq)))
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            u = ((i - ap) * (cq - aq) - (cp - ap) * (j - aq)) / area
            v = ((bp - ap) * (j - aq) - (i - ap) * (bq - aq)) / area
            if u >= -1e-9 and v >= -1e-9 and u + v <= 1 + 1e-9:
                # 1 / depth, not depth, is linear in image coordinates
                inverse = (1 - u - v) / ad + u / bd + v / cd
                depth[i, j] = min(depth[i, j], 1 / inverse)


@njit()
def rasterize_depth(vertices, faces, eye, axes, focal, near, depth):
    """Rasterise faces into a perspective depth image: the minimum of old and new depths.

    Triangles are clipped at the near plane.
    """
    rows, cols = depth.shape
    camera = np.empty_like(vertices)  # in the camera frame: along rows, along columns, depth
    for v in range(vertices.shape[0]):
        x, y, z = vertices[v, 0] - eye[0], vertices[v, 1] - eye[1], vertices[v, 2] - eye[2]
        for k in range(3):
            camera[v, k] = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z
    corner = np.empty((4, 3))  # a clipped triangle has at most four corners
    for f in range(faces.shape[0]):
        count = 0
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            da, db = camera[a, 2], camera[b, 2]
            if da >= near:
                corner[count] = camera[a]
                count += 1
            if (da >= near) != (db >= near):
                weight = (near - da) / (db - da)
                for m in range(3):
                    corner[count, m] = camera[a, m] + weight * (camera[b, m] - camera[a, m])
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


@njit()
def unproject(depth, eye, axes, focal, recesses, low, high, out, start):
    """Convert a perspective depth image to points in the world frame.

    Points of the floor inside a recess are moved down by its depth. Those between the corners
    ``low`` and ``high`` of a box are written to ``out`` [N, 3] from row ``start`` on. The result is
    the row after the last point.
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


@njit()
def splat(points, count, x0, y0, pixel, image):
    """Set a height image to the greatest height of the first ``count`` points in each pixel.

    Pixels without points take the value of the nearest pixel with points. Without any points, the
    image is unchanged. The geometry of the image is as in `rasterize_heights`.
    """
    rows, cols = image.shape
    heights = np.full((rows, cols), -np.inf)
    for n in range(count):
        i, j = math.floor((points[n, 0] - x0) / pixel), math.floor((points[n, 1] - y0) / pixel)
        if 0 <= i < rows and 0 <= j < cols:
            heights[i, j] = max(heights[i, j], points[n, 2])
    # for each pixel, the nearest column of its row with points
    column = np.full((rows, cols), -1)
    for i in range(rows):
        last = -1
        for j in range(cols):
            if heights[i, j] > -np.inf:
                last = j
            column[i, j] = last
        last = -1
        for j in range(cols - 1, -1, -1):
            if heights[i, j] > -np.inf:
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
                            image[i, j] = heights[k, column[k, j]]


@njit()
def project(heights, levels, rotation):
    """Return the numbers of occupied voxels along the three axes of the tool frame, [3, n, n].

    A voxel is occupied if its level [n], the height of its centre, is below the height of its pixel
    [n, n]. Occupied voxels are rotated about the centre of the cube into the nearest cells of the
    tool frame, whose rotation is relative to the heightmap, and the cells are filtered by a median
    with a kernel of 2 x 2 x 2, where a tie is occupied: the kernel of cell (i, j, k) starts at
    (i - 1, j - 1, k - 1), and the border is replicated.
    """
    n = len(levels)
    middle = (n - 1) / 2
    voxels = np.zeros((n, n, n), dtype=np.uint8)
    for i in range(n):
        for j in range(n):
            a, b = i - middle, j - middle
            for k in range(n):
                if not heights[i, j] > levels[k]:
                    break
                c = k - middle
                x = _cell(a * rotation[0, 0] + b * rotation[1, 0] + c * rotation[2, 0] + middle)
                y = _cell(a * rotation[0, 1] + b * rotation[1, 1] + c * rotation[2, 1] + middle)
                z = _cell(a * rotation[0, 2] + b * rotation[1, 2] + c * rotation[2, 2] + middle)
                if 0 <= x < n and 0 <= y < n and 0 <= z < n:
                    voxels[x, y, z] = 1
    sums = np.zeros((3, n, n))
    for i in range(n):
        before_i = max(i - 1, 0)
        for j in range(n):
            before_j = max(j - 1, 0)
            previous = 0
            for k in range(n):
                count = (
                    voxels[before_i, before_j, k]
                    + voxels[before_i, j, k]
                    + voxels[i, before_j, k]
                    + voxels[i, j, k]
                )
                if k == 0:
                    previous = count
                if previous + count >= 4:
                    sums[0, j, k] += 1
                    sums[1, i, k] += 1
                    sums[2, i, j] += 1
                previous = count
    return sums


@njit(inline="always")
def _cell(position):
    return math.floor(position + 0.5 + TIE_TOLERANCE)
