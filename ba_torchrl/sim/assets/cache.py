"""Convex parts on disk: what takes long to work out is worked out once per machine."""

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
"""Environment variable with the folder to use instead of the user's cache folder."""


def cache_folder() -> Path:
    """Return the folder that holds the cached parts; it may not exist yet."""
    root = os.environ.get(CACHE_VARIABLE)
    return (Path(root) if root else user_cache_path("ba_torchrl")) / "parts"


def cached_parts(
    content: bytes, recipe: str, make: Callable[[], Sequence[Mesh]]
) -> tuple[Mesh, ...]:
    """Return convex parts from the cache, or make and keep them.

    Several processes may ask for the same parts at once: a file appears complete or not at all.

    Args:
        content: of the file that the parts are made from.
        recipe: what is done to it; another recipe gives another entry.
        make: works the parts out.
    """
    key = hashlib.sha256(recipe.encode() + b"\0" + content).hexdigest()
    path = cache_folder() / f"{key}.npz"
    try:
        return _read(path)
    except FileNotFoundError:
        pass
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        logger.warning("%s is not readable and is made anew: %s", path, error)
    parts = tuple(make())
    try:
        _write(path, parts)
    except OSError as error:
        logger.warning(
            "cannot keep convex parts for next time in %s (%s): set %s to a folder that can be "
            "written to",
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
