"""Cache on disk for the convex parts of meshes, so that they are computed once per machine."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from platformdirs import user_cache_path

from ba_torchrl.sim.meshes import Mesh

logger = logging.getLogger(__name__)

CACHE_VARIABLE = "BA_TORCHRL_CACHE"
"""Environment variable that replaces the user's cache folder."""


def cache_folder() -> Path:
    """Return the folder of the cached parts, which may not exist."""
    root = os.environ.get(CACHE_VARIABLE)
    return (Path(root) if root else user_cache_path("ba_torchrl")) / "parts"


def cached_parts(
    content: bytes, recipe: str, make: Callable[[], Sequence[Mesh]]
) -> tuple[Mesh, ...]:
    """Return convex parts from the cache, or compute and store them.

    Several processes can request the same parts concurrently: files are written atomically.

    Args:
        content: content of the file from which the parts are computed.
        recipe: identifies the computation and its parameters; it is part of the cache key.
        make: computes the parts.
    """
    key = hashlib.sha256(recipe.encode() + b"\0" + content).hexdigest()
    path = cache_folder() / f"{key}.npz"
    try:
        return _read(path)
    except FileNotFoundError:
        pass
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        logger.warning("%s cannot be read and is computed again: %s", path, error)
    parts = tuple(make())
    try:
        _write(path, parts)
    except OSError as error:
        logger.warning(
            "cannot store convex parts in %s (%s): set %s to a writable folder",
            path.parent,
            error,
            CACHE_VARIABLE,
        )
    return parts


def _read(path: Path) -> tuple[Mesh, ...]:
    with np.load(path, allow_pickle=False) as data:
        vertices, faces = data["vertices"], data["faces"]
        vertex_ends, face_ends = data["vertex_ends"], data["face_ends"]
    starts = zip([0, *vertex_ends], [0, *face_ends], strict=True)
    return tuple(
        Mesh(vertices[v0:v1], faces[f0:f1])
        for (v0, f0), v1, f1 in zip(starts, vertex_ends, face_ends, strict=False)
    )


def _write(path: Path, parts: Sequence[Mesh]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        try:
            np.savez(
                file,
                vertices=np.concatenate([part.vertices for part in parts]),
                faces=np.concatenate([part.faces for part in parts]),
                vertex_ends=np.cumsum([len(part.vertices) for part in parts]),
                face_ends=np.cumsum([len(part.faces) for part in parts]),
            )
            file.close()
            os.replace(file.name, path)
        except BaseException:
            Path(file.name).unlink(missing_ok=True)
            raise
