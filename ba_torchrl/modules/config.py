"""Hyper-parameters of networks, which are built for images and actions."""

from __future__ import annotations

from collections.abc import Sequence
from pkgutil import resolve_name
from typing import Any, ClassVar

from ba_torchrl.core.choices import Control
from ba_torchrl.core.config import StrictModel
from ba_torchrl.core.registry import Registry

MAX_WIDTH = 32
"""Largest factor on the width of layers."""
MAX_DIHEDRAL = 16
"""Most rotations of a group with reflections; its kernels take ten seconds of a CPU to compute."""
MAX_EQUIVARIANT_YAWS = 32
"""Most yaws of an equivariant network, whose group has up to twice as many elements."""


class NetworkConfig(StrictModel):
    """A registered network: its hyper-parameters, and how it is built.

    Its module imports no torch: this package's classes name in `builder` what builds the network.
    Another one can override `build` instead.
    """

    builder: ClassVar[str]
    """The function that `build` imports and calls with the configuration and ``spec``, as
    "module:function"."""

    control: ClassVar[Control]
    """Control of the tasks that it supports. ``build`` returns an `ActorCritic` for close-loop
    tasks and a `ba_torchrl.modules.spatial.base.SpatialQNetwork` for open-loop tasks."""
    image_keys: ClassVar[tuple[str, ...]]
    """Keys of its input images, in the order of its arguments; the holding flag follows."""
    vector_keys: ClassVar[Sequence[str]]
    """Keys of its input vectors, which follow the holding flag: a field, or of the class."""
    shares_encoder: ClassVar[bool] = False
    """Whether the policy sees features of the critics' encoder."""

    def build(self, spec: Any) -> Any:
        """Return freshly initialised modules.

        Args:
            spec: images and action, an `ActorCriticSpec` or a `SpatialSpec`.

        Raises:
            ValueError: the network does not support the size or kind of an image or the components
                of the action, or they do not fit its hyper-parameters.
        """
        return resolve_name(self.builder)(self, spec)


NETWORKS: Registry[type[NetworkConfig]] = Registry(
    "network", "ba_torchrl.modules", NetworkConfig, "_config"
)
