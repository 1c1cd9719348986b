"""Meshes in a folder of the user, such as those of GraspNet-1Billion (appendix, figure 16)."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import pybullet

from ba_torchrl.errors import ConfigError
from ba_torchrl.sim.assets.base import OBJECT_SETS, ObjectSet
from ba_torchrl.sim.assets.cache import cached_parts
from ba_torchrl.sim.assets.hulls import convex_hull, volume_and_center
from ba_torchrl.sim.meshes import Mesh, write_obj

logger = logging.getLogger(__name__)

PREFERRED_FILES = ("nontextured_simplified.obj", "nontextured.obj")
"""Names preferred where a folder contains several mesh files."""
EXPECTED_LAYOUT = "expected one sub-folder for each object, with a mesh file (.obj, metres) in each"

MAX_WIDTH_M, WIDTH_FACTOR = 0.15, 0.8
MAX_VOLUME_M3, VOLUME_FACTOR = 6e-4, 0.85
MIN_THICKNESS_M, THICKNESS_FACTOR = 0.014, 1 / 0.95

MAX_LENGTH_M = 0.35
"""Greatest length after scaling: the diagonal of the flat base of the tray, which is 0.25 m wide
in the close-loop tasks. Cutlery, which `graspable_scale` enlarges to 0.3 m, fits diagonally."""
MESH_LENGTHS_M = (1e-5, 1e6)
"""Range of lengths before scaling. It admits meshes in units from micrometres to kilometres, which
`graspable_scale` corrects, and excludes lengths at which the arithmetic fails."""
MIN_FLATNESS = 1e-3
"""Least ratio of thickness to length of a solid."""

CONVEX_FILL = 0.95
"""Least ratio of the volume of a convex mesh to that of its convex hull."""
VHACD = {"resolution": 100_000, "depth": 20, "concavity": 0.0025, "maxNumVerticesPerCH": 48}
RECIPE = f"graspnet 2 {CONVEX_FILL} {VHACD} {MESH_LENGTHS_M} {MAX_LENGTH_M} {MIN_FLATNESS}"
"""Cache key. It includes the limits because cached meshes are not checked again."""


@OBJECT_SETS.register("graspnet")
class GraspNet(ObjectSet):
    """One object for each sub-folder of ``asset_root``, scaled so that a gripper can grasp it.

    At its first use, a mesh is decomposed into convex parts, which takes seconds; the parts are
    cached on disk.

    Args:
        asset_root: folder with one sub-folder for each object.

    Raises:
        ConfigError: the folder or a mesh file is missing or cannot be read.
    """

    def __init__(self, asset_root: str | None = None) -> None:
        super().__init__()
        if not asset_root:  # an empty path would be the current folder
            raise ConfigError(
                f"object_set='graspnet' needs asset_root, a folder: {EXPECTED_LAYOUT}"
            )
        root = Path(os.path.expanduser(asset_root))
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
        """Return the convex parts of a mesh, scaled.

        Raises:
            ConfigError: the file cannot be read, or its mesh does not satisfy the limits.
        """
        path = self.paths[index]

        def decompose() -> list[Mesh]:
            mesh = read_mesh(path)
            check_size(mesh, path)  # before the decomposition, which takes seconds
            return convex_parts(mesh, path)

        with _as_config_error(path):
            content = path.read_bytes()
        parts = cached_parts(content, RECIPE, decompose)
        points = np.concatenate([part.vertices for part in parts])
        scale = graspable_scale(np.ptp(points, axis=0))
        return tuple(Mesh(part.vertices * scale, part.faces) for part in parts)


def graspable_scale(extents_m: Sequence[float]) -> float:
    """Return the scale at which a mesh is graspable.

    The mesh is scaled by 0.8 until its second-largest extent is at most 15 cm, then by 0.85 until
    the volume of its bounding box is at most 0.6 litres, then by 1 / 0.95 until its smallest extent
    is at least 1.4 cm.

    Args:
        extents_m: extents of the axis-aligned bounding box.
    """
    smallest, middle, _ = sorted(extents_m)
    scale = WIDTH_FACTOR ** _num_factors(middle / MAX_WIDTH_M, 1 / WIDTH_FACTOR)
    scale *= VOLUME_FACTOR ** _num_factors(
        float(np.prod(extents_m)) * scale**3 / MAX_VOLUME_M3, VOLUME_FACTOR**-3
    )
    return scale * THICKNESS_FACTOR ** _num_factors(
        MIN_THICKNESS_M / (smallest * scale), THICKNESS_FACTOR
    )


def check_size(mesh: Mesh, path: Path) -> None:
    """Check that a mesh is a solid that fits into the tray at its graspable scale.

    Args:
        mesh: the mesh, metres.
        path: its file, used in error messages.

    Raises:
        ConfigError: the mesh is flat, its length is outside of `MESH_LENGTHS_M`, or its scaled
            length exceeds `MAX_LENGTH_M`.
    """
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
    if longest * scale > MAX_LENGTH_M:
        raise ConfigError(
            f"{measured}, and at its graspable scale {_format_extents(extents * scale)}: the tray "
            f"has room for {MAX_LENGTH_M} m; use a less elongated mesh, or remove its folder"
        )


def _num_factors(ratio: float, factor: float) -> int:
    """Return the least number of divisions by ``factor`` after which ``ratio`` is at most 1."""
    return max(0, math.ceil(math.log(ratio) / math.log(factor) - 1e-9))


def read_mesh(path: Path) -> Mesh:
    """Return the mesh in a file.

    Raises:
        ConfigError: the file contains too few triangles or coordinates that are not finite.
    """
    import trimesh  # imported here: it takes most of a second, and only this object set needs it

    try:
        loaded = trimesh.load(path, process=False, force="mesh", skip_materials=True)
        vertices = np.asarray(loaded.vertices, dtype=np.float64)
        faces = np.asarray(loaded.faces, dtype=np.int64)
    except Exception as error:  # the parser raises exceptions of many types
        raise ConfigError(f"asset_root: cannot read {str(path)!r} as a mesh: {error}") from error
    if len(faces) < 4 or not np.isfinite(vertices).all():
        raise ConfigError(
            f"asset_root: {str(path)!r} has {len(faces)} triangles and "
            f"{'in' if not np.isfinite(vertices).all() else ''}finite coordinates: it is no solid"
        )
    return Mesh(vertices, faces)


def convex_parts(mesh: Mesh, path: Path) -> list[Mesh]:
    """Return the approximate convex decomposition of a mesh (V-HACD).

    Args:
        mesh: the mesh, metres.
        path: its file, used in messages.

    Raises:
        ConfigError: the mesh has no volume.
    """
    try:
        hull = convex_hull(mesh.vertices)
    except ValueError as error:
        raise ConfigError(f"asset_root: {str(path)!r} has no volume: {error}") from None
    if volume_and_center(mesh)[0] >= CONVEX_FILL * volume_and_center(hull)[0]:
        return [hull]
    logger.info("decomposing %s into convex parts; the result is cached", path)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "mesh.obj"), Path(folder, "parts.obj")
        write_obj(source, [mesh])
        with _silent_stdout():
            pybullet.vhacd(str(source), str(target), str(Path(folder, "log.txt")), **VHACD)
        clouds = _read_objects(target) if target.exists() else []
    parts = []
    for cloud in clouds:
        with contextlib.suppress(ValueError):  # parts without volume are omitted
            parts.append(convex_hull(cloud))
    if not parts:
        logger.warning("%s cannot be decomposed into convex parts: using its convex hull", path)
        return [hull]
    return parts


def _principal_extents(points: np.ndarray) -> np.ndarray:
    """Return the extents [3] of points [N, 3] along their principal axes, in ascending order.

    Unlike those of the bounding box, they do not depend on the orientation of the mesh.
    """
    unit = np.abs(points).max() or 1.0  # avoids underflow and overflow of the squares
    centred = points / unit - np.mean(points / unit, axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return np.sort(np.ptp(centred @ axes, axis=0)) * unit


def _format_extents(extents_m: np.ndarray) -> str:
    return " x ".join(f"{extent:.2g}" for extent in extents_m) + " m"


def _mesh_file(folder: Path) -> Path:
    """Return the mesh file of a sub-folder.

    Raises:
        ConfigError: there is no mesh file, or the path is not a file.
    """
    rank = {name: i for i, name in enumerate(PREFERRED_FILES)}
    with _as_config_error(folder):
        meshes = [path for path in folder.iterdir() if path.suffix.lower() == ".obj"]
        if not meshes:
            raise ConfigError(f"asset_root: {str(folder)!r} has no mesh file: {EXPECTED_LAYOUT}")
        path = min(meshes, key=lambda path: (rank.get(path.name.lower(), len(rank)), path.name))
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


def _read_objects(path: Path) -> list[np.ndarray]:
    """Return the vertices [N, 3] of each object of an OBJ file."""
    clouds: list[list[list[float]]] = []
    for line in path.read_text().splitlines():
        kind, *values = line.split() or [""]
        if kind == "o":
            clouds.append([])
        elif kind == "v":
            clouds[-1].append([float(value) for value in values[:3]])
    return [np.array(cloud) for cloud in clouds if cloud]


@contextlib.contextmanager
def _silent_stdout() -> Iterator[None]:
    """Discard what C code prints to the standard output: hundreds of lines of progress."""
    sys.stdout.flush()
    stdout = os.dup(1)
    with open(os.devnull, "wb") as null:
        os.dup2(null.fileno(), 1)
        try:
            yield
        finally:
            os.dup2(stdout, 1)
            os.close(stdout)
