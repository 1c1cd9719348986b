"""Hyper-parameters of the equivariant actor-critic, also with strided convolutions."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field, model_validator
from typing_extensions import Self

from ba_torchrl.modules.actor_critic.image_config import ImageNetworkConfig
from ba_torchrl.modules.config import MAX_DIHEDRAL, NETWORKS


@NETWORKS.register("equi")
class EquivariantConfig(ImageNetworkConfig):
    """Hyper-parameters of the equivariant actor-critic.

    Args:
        group_order: number of rotations n of the group, at least 2; the default is from the
            reference implementation.
        reflections: the group is the dihedral group D_n, with n at least 3, instead of the cyclic
            group C_n.
        n_hidden: number of regular fields of the last layers; the default is from the reference
            implementation. The first layer has an eighth of it
            at 128 px, and a quarter at 64 px, where the first stage is left out.
    """

    builder: ClassVar[str] = "ba_torchrl.modules.actor_critic.equivariant:build_equivariant"
    is_strided: ClassVar[bool] = False
    """Whether strides take the place of max pools."""

    group_order: int = Field(default=8, ge=2, le=32)
    reflections: bool = False
    n_hidden: int = Field(default=64, ge=4, le=1024)

    @model_validator(mode="after")
    def _check_reflections(self) -> Self:
        if self.reflections and self.group_order > MAX_DIHEDRAL:
            raise ValueError(f"group_order is at most {MAX_DIHEDRAL} with reflections")
        return self


@NETWORKS.register("equi_strided")
class StridedEquivariantConfig(EquivariantConfig):
    """Hyper-parameters of the equivariant actor-critic with strided convolutions, not max pools.

    Not part of the paper. A 4x4 kernel with stride 2 reads pixels that are symmetric about the
    centre of the image, so that quarter turns remain exact; a 3x3 kernel with stride 2 does not. It
    takes four products per input pixel and pair of channels where a 3x3 kernel before a max pool
    takes nine. The stages, their numbers of fields and the arguments are as in
    `EquivariantConfig`.
    """

    is_strided: ClassVar[bool] = True
