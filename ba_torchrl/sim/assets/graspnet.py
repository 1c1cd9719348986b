"""A folder of the user's meshes, such as the models of GraspNet-1Billion (appendix, figure 16)."""

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
"""Taken first where a folder holds several mesh files."""
EXPECTED_LAYOUT = "expected one sub-folder for each object, with a mesh file (.obj, metres) in each"

MAX_WIDTH_M, WIDTH_FACTOR = 0.15, 0.8
MAX_VOLUME_M3, VOLUME_FACTOR = 6e-4, 0.85
MIN_THICKNESS_M, THICKNESS_FACTOR = 0.014, 1 / 0.95

MAX_LENGTH_M = 0.35
"""What is longer has no room in the tray: the diagonal of its flat floor, 0.25 m wide in the
close-loop tasks. Cutlery of 0.3 m, as the rules above enlarge it, lies across."""
MESH_LENGTHS_M = (1e-5, 1e6)
"""Lengths of a mesh before it is scaled: micrometres to kilometres may be its unit, as the rules
above scale it. Far outside arithmetic fails."""
MIN_FLATNESS = 1e-3
"""What is thinner than this share of its length is a sheet and no solid."""

CONVEX_FILL = 0.95
"""A mesh that fills this share of its hull is taken for convex."""
VHACD = {"resolution": 100_000, "depth": 20, "concavity": 0.0025, "maxNumVerticesPerCH": 48}
RECIPE = f"graspnet 2 {CONVEX_FILL} {VHACD} {MESH_LENGTHS_M} {MAX_LENGTH_M} {MIN_FLATNESS}"
"""The limits belong to it: what was kept is not checked again."""


@OBJECT_SETS.register("graspnet")
class GraspNet(ObjectSet):
    """One object for each sub-folder of ``asset_root``, scaled to what a gripper can grasp.

    Meshes are cut into convex parts the first time they are used, which takes seconds each, and
    kept on disk.
    """

    def __init__(self, asset_root: str | None = None) -> None:
        super().__init__()
        if not asset_root:  # an empty path would stand for the current folder
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
            ConfigError: the file cannot be read, or is no mesh of an object that fits.
        """
        path = self.paths[index]

        def decompose() -> list[Mesh]:
            mesh = read_mesh(path)
            check_size(mesh, path)  # first, as cutting takes seconds
            return convex_parts(mesh, path)

        with _as_config_error(path):
            content = path.read_bytes()
        parts = cached_parts(content, RECIPE, decompose)
        points = np.concatenate([part.vertices for part in parts])
        scale = graspable_scale(np.ptp(points, axis=0))
        return tuple(Mesh(part.vertices * scale, part.faces) for part in parts)


def graspable_scale(extents_m: Sequence[float]) -> float:
    """Return the factor that makes a mesh graspable.

    Shrunk by 0.8 until its second-largest extent is at most 15 cm, then by 0.85 until its bounding
    box is at most 0.6 litres, then enlarged by 1 / 0.95 until its smallest extent is 1.4 cm.

    Args:
        extents_m: of the axis-aligned bounding box.
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
    """Check that a mesh is a solid which fits the tray once it is graspable.

    Args:
        mesh: metres.
        path: where it is from, for messages.

    Raises:
        ConfigError: it is flat, outside `MESH_LENGTHS_M`, or when scaled longer than `MAX_LENGTH_M`.
    """
    sides = _principal_extents(mesh.vertices)
    thinnest, _, longest = sides
    if not MESH_LENGTHS_M[0] <= longest <= MESH_LENGTHS_M[1]:
        raise ConfigError(
            f"asset_root: {str(path)!r} measures {_format_extents(sides)}: it must be from "
            f"{MESH_LENGTHS_M[0]:g} to {MESH_LENGTHS_M[1]:g} m long; check its unit, or remove its folder"
        )
    if thinnest <= MIN_FLATNESS * longest:
        raise ConfigError(
            f"asset_root: {str(path)!r} measures {_format_extents(sides)}: it is flat, which is no "
            "solid; give the mesh a thickness, or remove its folder"
        )
    scale = graspable_scale(np.ptp(mesh.vertices, axis=0))
    if longest * scale > MAX_LENGTH_M:
        raise ConfigError(
            f"asset_root: {str(path)!r} measures {_format_extents(sides)}, and when scaled so that it "
            f"can be grasped {_format_extents(sides * scale)}: the tray has room for {MAX_LENGTH_M} m; "
            "use a less elongated mesh, or remove its folder"
        )


def _num_factors(excess: float, step: float) -> int:
    """Return how often to divide ``excess`` by ``step`` until it is at most 1."""
    return max(0, math.ceil(math.log(excess) / math.log(step) - 1e-9))


def read_mesh(path: Path) -> Mesh:
    """Read a mesh file.

    Raises:
        ConfigError: it holds no triangles, or values that are not finite.
    """
    import trimesh  # most of a second, and only this set needs it

    try:
        loaded = trimesh.load(path, process=False, force="mesh", skip_materials=True)
        vertices = np.asarray(loaded.vertices, dtype=np.float64)
        faces = np.asarray(loaded.faces, dtype=np.int64)
    except Exception as error:  # the parser fails in many ways on what is no mesh
        raise ConfigError(f"asset_root: cannot read {str(path)!r} as a mesh: {error}") from error
    if len(faces) < 4 or not np.isfinite(vertices).all():
        raise ConfigError(
            f"asset_root: {str(path)!r} has {len(faces)} triangles and "
            f"{'in' if not np.isfinite(vertices).all() else ''}finite coordinates: it is no solid"
        )
    return Mesh(vertices, faces)


def convex_parts(mesh: Mesh, path: Path) -> list[Mesh]:
    """Cut a mesh into convex parts.

    Args:
        mesh: metres.
        path: where it is from, for messages.

    Raises:
        ConfigError: it has no volume.
    """
    try:
        hull = convex_hull(mesh.vertices)
    except ValueError as error:
        raise ConfigError(f"asset_root: {str(path)!r} has no volume: {error}") from None
    if volume_and_center(mesh)[0] >= CONVEX_FILL * volume_and_center(hull)[0]:
        return [hull]
    logger.info("cutting %s into convex parts; this happens once", path)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "mesh.obj"), Path(folder, "parts.obj")
        write_obj(source, [mesh])
        with _silent_stdout():
            pybullet.vhacd(str(source), str(target), str(Path(folder, "log.txt")), **VHACD)
        clouds = _read_objects(target) if target.exists() else []
    parts = []
    for cloud in clouds:
        with contextlib.suppress(ValueError):  # a sliver without volume holds nothing up
            parts.append(convex_hull(cloud))
    if not parts:
        logger.warning("%s could not be cut into convex parts: its hull stands for it", path)
        return [hull]
    return parts


def _principal_extents(points: np.ndarray) -> np.ndarray:
    """Return the extents [3] of points [N, 3] along their principal axes, the smallest first.

    They tell a sheet or a bar however it lies in its file, where the bounding box does not.
    """
    unit = np.abs(points).max() or 1.0  # squares of what is tiny or huge would not be numbers
    centred = points / unit - np.mean(points / unit, axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return np.sort(np.ptp(centred @ axes, axis=0)) * unit


def _format_extents(extents_m: np.ndarray) -> str:
    return " x ".join(f"{extent:.2g}" for extent in extents_m) + " m"


def _mesh_file(folder: Path) -> Path:
    """Return the mesh file of a sub-folder.

    Raises:
        ConfigError: there is none, or what would be taken is no file.
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
    """Turn what the file system refuses into an error that names the path."""
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
    """Keep what C code prints away from the user: hundreds of lines of progress."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        try:
            yield
        finally:
            os.dup2(kept, 1)
            os.close(kept)
