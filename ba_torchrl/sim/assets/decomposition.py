"""Convex parts of any mesh: its hull, or an approximate decomposition (V-HACD)."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.assets.cache import Decomposition
from ba_torchrl.sim.assets.hulls import convex_hull, simplified_hull, volume_and_center
from ba_torchrl.sim.meshes import Mesh, merge_meshes, polygon_triangles, read_obj, write_obj

logger = logging.getLogger(__name__)

CONVEX_FILL = 0.95
"""Least volume of a convex mesh as a share of its convex hull's."""
SOLID_FILL = 0.8
"""Least volume of the parts as a share of the mesh's; thin shells have much less."""
THICK_FILL = 1.5
"""Greatest volume of the parts, in the mesh's, without a note."""
SHEET_FILL = 0.05
"""Greatest volume of a mesh that consists of sheets, as a share of its parts' volume."""
EXTENT_TOLERANCE = 0.05
"""Greatest difference between the bounding boxes of parts and mesh, in lengths of the mesh."""
VHACD = {"resolution": 100_000, "depth": 20, "concavity": 0.0025, "maxNumVerticesPerCH": 48}
VOXELS = 46
"""Edge of a cube with as many voxels as V-HACD's resolution."""
VHACD_LIMIT_S = 900.0
"""Time limit of a decomposition, which takes seconds."""
_VHACD_PROGRAM = (
    "import json, locale, sys, pybullet; locale.setlocale(locale.LC_NUMERIC, 'C'); "
    "pybullet.vhacd(*sys.argv[1:4], **json.loads(sys.argv[4]))"
)


def convex_parts(mesh: Mesh, path: Path) -> Decomposition:
    """Return convex parts that approximate the solid inside a surface.

    Holes of the surface through which V-HACD does not find the inside are closed with flat faces.
    The parts are computed at unit size, so that the size and the position of the mesh have no
    effect. They are relative to the centre of the mesh's bounding box.

    Raises:
        ConfigError: the mesh has no volume, or its decomposition fails.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    unit = 2.0 ** np.ceil(np.log2((high - low).max()))  # a power of two: no rounding
    unit_mesh = Mesh((mesh.vertices - (low + (high - low) / 2)) / unit, mesh.faces)
    try:
        parts, note = _unit_parts(unit_mesh, path)
    except ValueError as error:
        raise ConfigError(f"asset_root: {str(path)!r} has no volume: {error}") from None
    return Decomposition(tuple(Mesh(part.vertices * unit, part.faces) for part in parts), note)


def _unit_parts(mesh: Mesh, path: Path) -> Decomposition:
    hull = convex_hull(mesh.vertices)
    whole, hull_volume = (simplified_hull(hull),), volume_and_center(hull)[0]
    mesh = _joined(mesh)
    loops = _border_loops(mesh)
    bodies = [_volume(body) for body in _bodies(mesh)]
    # bodies of a closed surface can overlap; the parts fill each of them
    solid = _volume(mesh) if loops else max(bodies)
    if solid >= CONVEX_FILL * hull_volume:
        return Decomposition(whole)
    parts = _vhacd(mesh, path)
    note = ""
    if loops:
        closed = _close(mesh, loops)
        solid = max(solid, _volume(closed))
        if sum(map(_volume, parts)) < SOLID_FILL * solid:
            convex = _volume(closed) >= CONVEX_FILL * hull_volume
            parts = list(whole) if convex else _vhacd(closed, path)
            widths = [np.ptp(mesh.vertices[loop], axis=0).max() for loop in loops]
            share = max(widths) / np.ptp(mesh.vertices, axis=0).max()
            note = (
                f"has holes in its surface ({len(loops)}; the width of the largest is {share:.0%} "
                "of the object's length): they are closed with flat faces, so that the object is "
                "solid and a gripper cannot reach inside; check that the file is complete, and "
                "give the walls of a vessel a thickness"
            )
    problem = _difference(parts, mesh, solid)
    if problem:
        return Decomposition(
            whole,
            f"cannot be decomposed into convex parts ({problem}): its convex hull is used, so that "
            "a gripper cannot reach into its hollows; close its surface, or simplify it",
        )
    filled = sum(map(_volume, parts))
    if not note and solid < SHEET_FILL * filled:
        note = (
            "has a surface of sheets without an inside: the object is hollow and has thin walls; "
            "close its surface, or give it a thickness"
        )
    elif not note and THICK_FILL * max(_volume(mesh), sum(bodies)) < filled:
        note = (
            f"has walls thinner than the resolution of its decomposition (about {1 / VOXELS:.0%} "
            "of its length): they are thicker in the simulation"
        )
    return Decomposition(tuple(parts), note)


def _difference(parts: list[Mesh], mesh: Mesh, volume: float) -> str:
    """Return what tells the parts of a mesh from the mesh, empty if they are equal enough."""
    if not parts:
        return "no part has a volume"
    points = merge_meshes(parts).vertices
    bounds = [
        np.concatenate([p.min(axis=0), p.max(axis=0)])
        for p in (points, mesh.vertices[np.unique(mesh.faces)])
    ]
    if np.abs(bounds[0] - bounds[1]).max() > EXTENT_TOLERANCE * np.ptp(mesh.vertices, axis=0).max():
        return "the parts and the mesh have different extents"
    filled = sum(map(_volume, parts))
    if filled < SOLID_FILL * volume:
        return f"the parts fill {filled / volume:.0%} of its volume"
    return ""


def _volume(mesh: Mesh) -> float:
    """Return the volume inside a mesh, whichever way its faces point; 0 for opposite sheets."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] - mesh.vertices.mean(axis=0) for i in range(3))
    return abs(float(np.einsum("fi,fi->", a, np.cross(b, c)))) / 6


def _joined(mesh: Mesh) -> Mesh:
    """Return a surface with one vertex for each position, without copies of a face, whose faces
    point the same way."""
    import trimesh  # imported here: it takes most of a second

    vertices, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    turns = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3  # the smallest index first
    first = np.unique(np.take_along_axis(faces, turns, axis=1), axis=0, return_index=True)[1]
    repaired = trimesh.Trimesh(vertices, faces[np.sort(first)], process=False)
    trimesh.repair.fix_winding(repaired)
    return Mesh(vertices, np.asarray(repaired.faces, dtype=np.int64))


def _edges(faces: np.ndarray) -> np.ndarray:
    """Return the directed edges [3 F, 2] of faces [F, 3]."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _bodies(mesh: Mesh) -> list[Mesh]:
    """Return the pieces of a mesh whose faces are connected by edges."""
    import trimesh

    count = len(mesh.faces)
    edges = trimesh.Trimesh(*mesh, process=False).faces_unique_edges
    # of each face with its edges: more than two faces may have one
    links = np.column_stack([np.repeat(np.arange(count), 3), count + edges.ravel()])
    groups = trimesh.graph.connected_components(links, engine="scipy")
    return [Mesh(mesh.vertices, mesh.faces[group[group < count]]) for group in groups]


def _border_loops(mesh: Mesh) -> list[list[int]]:
    """Return the vertices around each hole of a surface, in the order of a face that fills it."""
    edges, counts = np.unique(_edges(mesh.faces), axis=0, return_counts=True)
    balance: dict[tuple[int, int], int] = defaultdict(int)
    for (a, b), count in zip(edges.tolist(), counts.tolist(), strict=True):
        balance[a, b] += count
        balance[b, a] -= count
    following: dict[int, list[int]] = defaultdict(list)
    for (a, b), count in balance.items():
        following[b] += [a] * max(count, 0)  # a hole has the edge in the other direction
    loops = []
    for start in list(following):
        path, position = [start], {start: 0}
        while following[path[-1]]:
            vertex = following[path[-1]].pop()
            if vertex in position:  # as many edges arrive at a vertex as leave it
                loop = path[position[vertex] :]
                loops.append(loop)
                for used in loop[1:]:
                    del position[used]
                del path[position[vertex] + 1 :]
            else:
                position[vertex] = len(path)
                path.append(vertex)
    return loops


def _close(mesh: Mesh, loops: list[list[int]]) -> Mesh:
    """Return a surface with its holes filled."""
    caps = [
        [loop[i] for i in triangle]
        for loop in loops
        for triangle in polygon_triangles(mesh.vertices[loop])
    ]
    return Mesh(mesh.vertices, np.concatenate([mesh.faces, np.array(caps).reshape(-1, 3)]))


def _vhacd(mesh: Mesh, path: Path) -> list[Mesh]:
    """Return the convex parts of a mesh at unit size.

    A process of its own computes them: the C code can crash, and prints its progress.
    """
    logger.info("decomposing %s into convex parts; the result is cached", path)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "mesh.obj"), Path(folder, "parts.obj")
        write_obj(source, [mesh])
        files = [str(source), str(target), str(Path(folder, "log.txt"))]
        try:
            subprocess.run(
                [sys.executable, "-P", "-c", _VHACD_PROGRAM, *files, json.dumps(VHACD)],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                timeout=VHACD_LIMIT_S,
                check=True,
            )
        except (subprocess.SubprocessError, OSError) as error:
            reason = str(error).replace(str(getattr(error, "cmd", "")) or "\0", "V-HACD")
            printed = (getattr(error, "stderr", None) or b"").decode(errors="replace").split("\n")
            raise ConfigError(
                f"asset_root: {str(path)!r} cannot be decomposed into convex parts: "
                f"{' '.join([reason, *filter(None, printed[-2:])])} Simplify the mesh, which has "
                f"{len(mesh.faces)} triangles, or remove its folder"
            ) from error
        clouds = read_obj(target.read_bytes()) if target.exists() else []
    parts = []
    for cloud in clouds:
        try:
            parts.append(convex_hull(cloud.vertices))
        except ValueError as error:
            logger.debug("%s: a part without volume is left out: %s", path, error)
    return parts
