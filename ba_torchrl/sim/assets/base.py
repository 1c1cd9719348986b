"""ObjectSet: a collection of shapes from which a task samples its objects."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache
from typing import ClassVar, overload

import numpy as np

from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.registry import Registry
from ba_torchrl.sim.assets.hulls import volume_and_center
from ba_torchrl.sim.meshes import Mesh, transform_mesh
from ba_torchrl.sim.shapes import Color, Solid

PALETTE: tuple[Color, ...] = (
    (0.84, 0.31, 0.25, 1.0),
    (0.25, 0.48, 0.76, 1.0),
    (0.93, 0.7, 0.25, 1.0),
    (0.36, 0.66, 0.4, 1.0),
    (0.58, 0.42, 0.7, 1.0),
    (0.3, 0.68, 0.7, 1.0),
    (0.86, 0.5, 0.62, 1.0),
    (0.6, 0.47, 0.36, 1.0),
)


class ObjectSet(Sequence[Solid], ABC):
    """A sequence of shapes, each created at its first access.

    The origin of a shape's frame is its centre of mass.

    Args:
        asset_root: folder of the user's meshes, for object sets that read one.
    """

    mass_kg: ClassVar[float] = 0.15
    friction: ClassVar[float] = 0.6

    def __init__(self, asset_root: str | None = None) -> None:
        if asset_root is not None:
            raise ConfigError(
                f"asset_root: this object set is part of the package and reads no folder "
                f"(got {asset_root!r}); use object_set='graspnet' for a folder of meshes"
            )
        self._shapes: dict[int, Solid] = {}

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """Names of the shapes, in their order."""

    @abstractmethod
    def parts(self, index: int) -> tuple[Mesh, ...]:
        """Return the convex parts of a shape, metres, in any common frame."""

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> Solid: ...

    @overload
    def __getitem__(self, index: slice) -> list[Solid]: ...

    def __getitem__(self, index: int | slice) -> Solid | list[Solid]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        index = range(len(self))[index]
        if index not in self._shapes:
            parts = self.parts(index)
            volumes, centers = zip(*(volume_and_center(part) for part in parts), strict=True)
            center = np.average(centers, axis=0, weights=volumes)
            self._shapes[index] = Solid(
                parts=tuple(transform_mesh(part, tuple(-center)) for part in parts),
                mass_kg=self.mass_kg,
                friction=self.friction,
                color=PALETTE[index % len(PALETTE)],
            )
        return self._shapes[index]


OBJECT_SETS: Registry[type[ObjectSet]] = Registry("object set", "ba_torchrl.sim.assets", ObjectSet)


def load_object_set(name: str, asset_root: str | None = None) -> ObjectSet:
    """Return an object set by its name in `OBJECT_SETS`; "graspnet" reads ``asset_root``."""
    return _packaged_set(name) if asset_root is None else OBJECT_SETS[name](asset_root)


@cache
def _packaged_set(name: str) -> ObjectSet:
    """Return an object set that reads no folder; all worlds of a process share its shapes."""
    return OBJECT_SETS[name](None)
