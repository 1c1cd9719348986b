"""Meshes in a folder of the user, such as GraspNet-1Billion's (appendix, figure 16)."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from ba_torchrl.core.config import expanded
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.sim.assets.base import OBJECT_SETS, ObjectSet
from ba_torchrl.sim.assets.cache import Decomposition, cached_parts
from ba_torchrl.sim.assets.decomposition import (
    CONVEX_FILL,
    EXTENT_TOLERANCE,
    SHEET_FILL,
    SOLID_FILL,
    VHACD,
    convex_parts,
)
from ba_torchrl.sim.assets.hulls import HULL_ERROR, MAX_HULL_VERTICES
from ba_torchrl.sim.meshes import Mesh, merge_meshes, read_obj

logger = logging.getLogger(__name__)

SUFFIXES = (".obj", ".ply", ".stl", ".glb")
"""Formats of mesh files, the preferred one first."""
PREFERRED_NAMES = ("nontextured_simplified", "nontextured")
"""Names preferred where a folder contains several mesh files of a format."""
EXPECTED_LAYOUT = (
    "expected one sub-folder for each object, with a mesh file (.obj, .ply, .stl or .glb, metres) "
    "in each"
)

MAX_WIDTH_M, WIDTH_FACTOR = 0.15, 0.8
MAX_VOLUME_M3, VOLUME_FACTOR = 6e-4, 0.85
MIN_THICKNESS_M, THICKNESS_FACTOR = 0.014, 1 / 0.95

MAX_LENGTH_M = 0.35
"""Greatest length after scaling: the diagonal of the flat base of the tray, which is 0.25 m wide
in the close-loop tasks. Cutlery, which `graspable_scale` enlarges to 0.3 m, fits diagonally."""
MESH_LENGTHS_M = (1e-5, 1e6)
"""Range of lengths before scaling. It admits meshes in units from micrometres to kilometres, which
`graspable_scale` corrects, and excludes lengths at which the arithmetic fails."""
MAX_TRIANGLES = 5_000_000
"""Most triangles of a mesh. A small GLB file can place one mesh a million times."""
MIN_FLATNESS = 1e-3
"""Least ratio of thickness to length of a solid."""

RECIPE = (
    f"graspnet 3 {CONVEX_FILL} {SOLID_FILL} {SHEET_FILL} {EXTENT_TOLERANCE} {VHACD} "
    f"{MAX_HULL_VERTICES} {HULL_ERROR} {MESH_LENGTHS_M} {MAX_LENGTH_M} {MIN_FLATNESS}"
)
"""Cache key. It includes the limits because cached meshes are not checked again."""


_NOTHING = Mesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))


@OBJECT_SETS.register("graspnet")
class GraspNet(ObjectSet):
    """One object for each sub-folder of ``asset_root``, scaled so that a gripper can grasp it.

    At its first use, a mesh is decomposed into convex parts, which takes seconds; the parts are
    cached on disk. Holes of its surface are closed with flat faces where they leave the object
    hollow, and a warning tells so.
    """

    def __init__(self, asset_root: str | None = None) -> None:
        super().__init__()
        if not asset_root:  # an empty path would be the current folder
            raise ConfigError(
                f"object_set='graspnet' needs asset_root, a folder: {EXPECTED_LAYOUT}"
            )
        root = Path(expanded(asset_root))
        with _as_config_error(root):
            if not root.is_dir():
                raise ConfigError(
                    f"asset_root: there is no folder {str(root)!r}: {EXPECTED_LAYOUT}"
                )
            folders = sorted(
                path for path in root.iterdir() if path.is_dir() and not path.name.startswith(".")
            )
        if not folders:
            raise ConfigError(f"asset_root: {str(root)!r} has no sub-folders: {EXPECTED_LAYOUT}")
        self.paths = [_mesh_file(folder) for folder in folders]

    @cached_property
    def names(self) -> Sequence[str]:
        """Names of the sub-folders."""
        return [path.parent.name for path in self.paths]

    def parts(self, index: int) -> tuple[Mesh, ...]:
        """Return the convex parts of a mesh, scaled."""
        path = self.paths[index]

        def decompose() -> Decomposition:
            mesh = read_mesh(path)
            check_size(mesh, path)  # before the decomposition, which takes seconds
            made = convex_parts(mesh, path)
            # the parts are a little larger than the mesh
            check_size(merge_meshes(made.parts), path, MAX_LENGTH_M * (1 + EXTENT_TOLERANCE))
            return made

        with _as_config_error(path):
            content = path.read_bytes()
        parts, note = cached_parts(content, f"{RECIPE} {path.suffix.lower()}", decompose)
        if note:
            logger.warning("asset_root: %r %s", str(path), note)
        points = np.concatenate([part.vertices for part in parts])
        scale = graspable_scale(np.ptp(points, axis=0))
        return tuple(Mesh(part.vertices * scale, part.faces) for part in parts)


def graspable_scale(extents_m: Sequence[float]) -> float:
    """Return the scale at which a mesh with an axis-aligned bounding box is graspable.

    The mesh is scaled by 0.8 until its second-largest extent is at most 15 cm, then by 0.85 until
    the volume of its bounding box is at most 0.6 litres, then by 1 / 0.95 until its smallest extent
    is at least 1.4 cm.
    """
    smallest, middle, _ = sorted(extents_m)
    scale = WIDTH_FACTOR ** _num_factors(middle / MAX_WIDTH_M, 1 / WIDTH_FACTOR)
    scale *= VOLUME_FACTOR ** _num_factors(
        float(np.prod(extents_m)) * scale**3 / MAX_VOLUME_M3, VOLUME_FACTOR**-3
    )
    return scale * THICKNESS_FACTOR ** _num_factors(
        MIN_THICKNESS_M / (smallest * scale), THICKNESS_FACTOR
    )


def check_size(mesh: Mesh, path: Path, max_length_m: float = MAX_LENGTH_M) -> None:
    """Check that a mesh is a solid that fits into the tray at its graspable scale."""
    extents = _principal_extents(mesh.vertices)
    thinnest, _, longest = extents
    measured = f"asset_root: {str(path)!r} measures {_format_extents(extents)}"
    low, high = MESH_LENGTHS_M
    if not low <= longest <= high:
        raise ConfigError(
            f"{measured}: it must be from {low:g} to {high:g} m long; check its unit, or remove "
            "its folder"
        )
    if thinnest <= MIN_FLATNESS * longest:
        raise ConfigError(
            f"{measured}: it is flat and not a solid; give the mesh a thickness, or remove its "
            "folder"
        )
    scale = graspable_scale(np.ptp(mesh.vertices, axis=0))
    if longest * scale > max_length_m:
        raise ConfigError(
            f"{measured}, and at its graspable scale {_format_extents(extents * scale)}: the tray "
            f"has room for {MAX_LENGTH_M} m; use a less elongated mesh, or remove its folder"
        )


def _num_factors(ratio: float, factor: float) -> int:
    """Return the least number of divisions by ``factor`` after which ``ratio`` is at most 1."""
    return max(0, math.ceil(math.log(ratio) / math.log(factor) - 1e-9))


def read_mesh(path: Path) -> Mesh:
    """Return the mesh in a file, relative to the centre of its bounding box."""
    try:
        with _as_config_error(path):
            content = path.read_bytes()
        if path.suffix.lower() == ".obj":
            vertices, faces = merge_meshes([_NOTHING, *read_obj(content)])
        else:
            vertices, faces = _read_with_trimesh(content, path.suffix.lower()[1:])
    except ConfigError:
        raise
    except Exception as error:  # the parsers raise exceptions of many types
        raise ConfigError(f"asset_root: cannot read {str(path)!r} as a mesh: {error}") from error
    if len(faces) < 4 or not np.isfinite(vertices).all():
        raise ConfigError(
            f"asset_root: {str(path)!r} has {len(faces)} triangles and "
            f"{'in' if not np.isfinite(vertices).all() else ''}finite coordinates: it is no solid"
        )
    return Mesh(vertices - (vertices.min(axis=0) / 2 + vertices.max(axis=0) / 2), faces)


def _read_with_trimesh(content: bytes, file_type: str) -> Mesh:
    """Return the mesh in a file of one of the formats that trimesh reads, in metres."""
    import trimesh  # imported here: it takes most of a second

    if file_type == "glb":
        _check_glb(content)
    scene = trimesh.load(
        io.BytesIO(content), file_type=file_type, process=False, force="scene", skip_materials=True
    )
    placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    _check_triangles(sum(len(scene.geometry[name].faces) for _, name in placed))
    parts = [scene.geometry[name].copy().apply_transform(pose) for pose, name in placed]
    loaded = trimesh.util.concatenate(parts)
    used, faces = np.unique(np.asarray(loaded.faces), return_inverse=True)
    vertices = np.asarray(loaded.vertices, dtype=np.float64)[used]
    return Mesh(vertices, faces.reshape(-1, 3).astype(np.int64))


def _check_glb(content: bytes) -> None:
    """Check what a GLB file announces, for which trimesh would take memory or look elsewhere."""
    header = json.loads(content[20:][: int.from_bytes(content[12:16], "little")])
    for buffer in header.get("buffers", ()):
        if not buffer.get("uri", "data:").startswith("data:"):
            raise ValueError(f"its data are in {buffer['uri']!r}; export it as one file")
    _check_triangles(max((each["count"] for each in header.get("accessors", ())), default=0) // 3)


def _check_triangles(count: int) -> None:
    if count > MAX_TRIANGLES:
        raise ValueError(f"it has {count} triangles, the most are {MAX_TRIANGLES}; simplify it")


def _principal_extents(points: np.ndarray) -> np.ndarray:
    """Return the extents [3] of points [N, 3] along their principal axes, in ascending order.

    Unlike a bounding box's, these extents do not depend on the orientation of the mesh.
    """
    unit = np.abs(points).max() or 1.0  # avoids underflow and overflow of the squares
    centred = points / unit - np.mean(points / unit, axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return np.sort(np.ptp(centred @ axes, axis=0)) * unit


def _format_extents(extents_m: np.ndarray) -> str:
    return " x ".join(f"{extent:.2g}" for extent in extents_m) + " m"


def _mesh_file(folder: Path) -> Path:
    """Return the mesh file of a sub-folder."""
    names = {name: i for i, name in enumerate(PREFERRED_NAMES)}
    with _as_config_error(folder):
        meshes = [
            path
            for path in folder.iterdir()
            if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
        ]
        if not meshes:
            raise ConfigError(f"asset_root: {str(folder)!r} has no mesh file: {EXPECTED_LAYOUT}")
        path = min(
            meshes,
            key=lambda path: (
                SUFFIXES.index(path.suffix.lower()),
                names.get(path.stem.lower(), len(names)),
                path.name,
            ),
        )
        if not path.is_file():
            missing = path.is_symlink() and not path.exists()
            what = "a link to nothing" if missing else "a folder" if path.is_dir() else "no file"
            raise ConfigError(
                f"asset_root: {str(path)!r} is {what}: put a mesh file in its place, or remove "
                f"the folder {folder.name!r}"
            )
    return path


@contextlib.contextmanager
def _as_config_error(path: Path) -> Iterator[None]:
    """Raise a `ConfigError` that names the path instead of an `OSError`."""
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"asset_root: cannot read {str(path)!r} ({error.strerror or error}): restore it or "
            "make it readable, or remove it"
        ) from error
