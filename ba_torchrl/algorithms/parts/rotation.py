"""Transforms of transitions: rotations of close-loop ones, rigid transforms of open-loop ones."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from ba_torchrl.core import keys
from ba_torchrl.core.config import Part
from ba_torchrl.core.errors import ConfigError
from ba_torchrl.core.seeds import SeedUse

if TYPE_CHECKING:
    from torchrl.envs import Transform

    from ba_torchrl.algorithms.problem import Problem
    from ba_torchrl.core.images import ImageSpec
    from ba_torchrl.data.augmentation.so2 import SO2Augmentation
    from ba_torchrl.modules.spatial.policy import SpatialActions


class NoRotation(Part):
    """Transitions as they are."""

    name: Literal["none"] = "none"
    copies: ClassVar[int] = 0

    def build(self, *args: Any, **options: Any) -> list[Transform]:
        """Return no transform."""
        return []


class Sampled(Part):
    """Rotation about the z axis of sampled transitions."""

    name: Literal["sampled"] = "sampled"
    copies: ClassVar[int] = 0
    probability: float = Field(default=0.8, ge=0, le=1)
    """Probability of rotating a transition; not in the appendix."""

    def build(self, *args: Any) -> list[Transform]:
        """Return the transform of a replay; arguments as for `_so2`."""
        return [_so2(*args, SeedUse.AUGMENTATION, self.probability)]


class Stored(Part):
    """Rotated copies that are stored with each transition, as in the reference implementation."""

    name: Literal["stored"] = "stored"
    copies: int = Field(default=4, ge=1, le=100)
    """Number of copies of each transition; reference implementation."""

    def build(self, *args: Any) -> list[Transform]:
        """Return the transform of a replay; arguments as for `_so2`."""
        from ba_torchrl.data.augmentation.so2 import StoredCopies

        return [StoredCopies(_so2(*args, SeedUse.STORED_AUGMENTATION, 1.0), self.copies)]


def _so2(
    problem: Problem,
    images: Mapping[str, ImageSpec],
    vectors: Collection[str],
    use: SeedUse,
    probability: float,
) -> SO2Augmentation:
    """Return the rotation of transitions.

    Raises:
        ConfigError: the network has vectors, which are not rotated.
        ValueError: an image cannot be rotated.
    """
    from ba_torchrl.data.augmentation.so2 import SO2Augmentation

    if vectors:
        raise ConfigError(
            f"rotation turns images and actions, but not the network's vectors "
            f"({', '.join(vectors)}): set rotation.name=none, or leave out network.vector_keys"
        )
    sequence, seed = problem.actions.sequence, problem.derived_seed(use)
    return SO2Augmentation(images, sequence, probability=probability, seed=seed)


Rotation = Annotated[NoRotation | Sampled | Stored, Field(discriminator="name")]


class Rigid(Part):
    """Shifts ("translation"), quarter turns and reflections ("d4") or shifts and turns by any angle
    ("se2") of sampled open-loop transitions."""

    name: Literal["translation", "d4", "se2"]
    probability: float = Field(default=1.0, ge=0, le=1)
    """Probability of transforming a transition."""

    def build(
        self,
        problem: Problem,
        images: Mapping[str, ImageSpec],
        grid: SpatialActions,
        action_key: str = keys.ACTION,
    ) -> list[Transform]:
        """Return the transform of a replay; arguments as for `RigidAugmentation`.

        Raises:
            ValueError: images or actions of the task cannot be transformed.
        """
        from ba_torchrl.data.augmentation.rigid import RigidAugmentation

        options = self.model_dump(exclude={"name"})
        options |= {"seed": problem.derived_seed(SeedUse.AUGMENTATION), "action_key": action_key}
        return [RigidAugmentation(self.name, problem.actions, images, grid=grid, **options)]


class Cn(Rigid):
    """Turns of the cyclic group of sampled open-loop transitions."""

    name: Literal["cn"] = "cn"
    order: int = Field(default=16, ge=1, le=360)
    """Number of turns."""


RigidRotation = Annotated[NoRotation | Rigid | Cn, Field(discriminator="name")]
AnyRotation = Annotated[NoRotation | Sampled | Rigid | Cn, Field(discriminator="name")]
