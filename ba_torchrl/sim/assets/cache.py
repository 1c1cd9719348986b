"""Cache on disk for the convex parts of meshes, so that they are computed once per machine."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from platformdirs import user_cache_path

from ba_torchrl.sim.meshes import Mesh

logger = logging.getLogger(__name__)

CACHE_VARIABLE = "BA_TORCHRL_CACHE"
"""Environment variable that replaces the user's cache folder."""


class Decomposition(NamedTuple):
    """Convex parts that stand for a mesh."""

    parts: tuple[Mesh, ...]
    note: str = ""
    """How the parts differ from the mesh, if that matters for grasping."""


def cache_folder() -> Path:
    """Return the folder of the cached parts, which may not exist.

    Raises:
        OSError: the user has no home.
    """
    root = os.environ.get(CACHE_VARIABLE)
    try:
        return (Path(root).expanduser() if root else user_cache_path("ba_torchrl")) / "parts"
    except RuntimeError as error:
        raise FileNotFoundError(str(error)) from error


def cached_parts(content: bytes, recipe: str, make: Callable[[], Decomposition]) -> Decomposition:
    """Return convex parts of a file's content from the cache, or compute and store them.

    The cache is optional: one warning is given for a folder that cannot be used. Several processes
    can request the same parts concurrently: files are written atomically. ``recipe`` identifies the
    computation and its parameters; it is part of the cache key.
    """
    key = hashlib.sha256(recipe.encode() + b"\0" + content).hexdigest()
    try:
        path = cache_folder() / f"{key}.npz"
    except OSError as error:
        _warn_once("the user's cache", str(error))
        return make()
    try:
        return _read(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except PermissionError as error:
        _warn_once(str(path.parent), str(error.strerror))
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        logger.warning("%s cannot be read and is computed again: %s", path, error)
    made = make()
    try:
        _write(path, made)
    except OSError as error:
        _warn_once(str(path.parent), str(error.strerror or error))
    return made


_unusable: set[str] = set()
"""Folders for which a warning was given."""


def _warn_once(folder: str, problem: str) -> None:
    """Warn that convex parts cannot be kept in a folder, once for each folder."""
    if folder not in _unusable:
        _unusable.add(folder)
        logger.warning(
            "cannot keep convex parts in %s (%s): each process computes them; set %s to a "
            "writable folder",
            folder,
            problem,
            CACHE_VARIABLE,
        )


def _read(path: Path) -> Decomposition:
    with np.load(path, allow_pickle=False) as data:
        vertices, faces = data["vertices"], data["faces"]
        vertex_ends, face_ends = data["vertex_ends"], data["face_ends"]
        note = str(data["note"]) if "note" in data else ""  # absent from older entries
    starts = zip([0, *vertex_ends], [0, *face_ends], strict=True)
    parts = tuple(
        Mesh(vertices[v0:v1], faces[f0:f1])
        for (v0, f0), v1, f1 in zip(starts, vertex_ends, face_ends, strict=False)
    )
    return Decomposition(parts, note)


def _write(path: Path, made: Decomposition) -> None:
    parts, note = made
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        try:
            np.savez(
                file,
                vertices=np.concatenate([part.vertices for part in parts]),
                faces=np.concatenate([part.faces for part in parts]),
                vertex_ends=np.cumsum([len(part.vertices) for part in parts]),
                face_ends=np.cumsum([len(part.faces) for part in parts]),
                note=np.array(note),
            )
            file.close()
            os.replace(file.name, path)
        except BaseException:
            Path(file.name).unlink(missing_ok=True)
            raise
