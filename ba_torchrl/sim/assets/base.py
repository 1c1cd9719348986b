"""ObjectSet: shapes that a task draws its objects from, loaded when they are asked for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, overload

import numpy as np

from ba_torchrl.errors import ConfigError
from ba_torchrl.registry import Registry
from ba_torchrl.sim.assets.hulls import volume_and_center
from ba_torchrl.sim.meshes import Mesh, transform_mesh
from ba_torchrl.sim.shapes import Color, Solid

OBJECT_SETS: Registry[type[ObjectSet]] = Registry("object set", "ba_torchrl.sim.assets")

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
    """A sequence of shapes, each made when it is first asked for.

    The frame of a shape has its origin in the centre of mass.

    Args:
        asset_root: folder of the user's meshes, for sets that read one.

    Raises:
        ConfigError: the folder is needed and missing, or given without need.
    """

    mass_kg: ClassVar[float] = 0.15
    friction: ClassVar[float] = 0.6

    def __init__(self, asset_root: str | None = None) -> None:
        if asset_root is not None:
            raise ConfigError(
                f"asset_root: this object set comes with the package and reads no folder "
                f"(got {asset_root!r}); object_set='graspnet' does"
            )
        self._shapes: dict[int, Solid] = {}

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """What the shapes are called, in their order."""

    @abstractmethod
    def parts(self, index: int) -> tuple[Mesh, ...]:
        """Return the convex parts of a shape, metres, in any frame."""

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


def load_object_set(name: str, asset_root: str | None = None) -> ObjectSet:
    """Return a set of objects.

    Args:
        name: "random", "household" or "graspnet".
        asset_root: "graspnet": the folder with the meshes.

    Raises:
        ConfigError: there is no such set, or its folder is missing or cannot be used.
    """
    return OBJECT_SETS[name](asset_root)
