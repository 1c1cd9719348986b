"""Hyper-parameters of every network on depth images."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from ba_torchrl.core import keys
from ba_torchrl.core.choices import Control, Precision
from ba_torchrl.modules.config import NetworkConfig

if TYPE_CHECKING:
    from ba_torchrl.modules.base import ActorCriticSpec


class ImageNetworkConfig(NetworkConfig):
    """Hyper-parameters that every network on depth images has.

    The input of the networks is (depth - depth_center_m) / depth_scale_m. The defaults keep metres,
    as the reference implementation does. With a center of 0.2 and a scale of 0.1, inputs have unit
    size and differences of a block's height are well above the resolution of bfloat16; learning is
    much faster.

    With the floor as the reference, the floor's depth is an input of its own, the same at all
    pixels, and the image becomes heights above it, so that the activations of the floor do not
    exceed the objects' activations.

    Args:
        precision: number format of the convolutions, see `compute_dtype`.
        depth_reference: "camera", or "floor" for two inputs: height above the lowest visible point,
            and the depth of that point.
        depth_center_m: depth that is scaled to zero.
        depth_scale_m: difference in depth that is scaled to one.
        negative_slope: slope of the activation function below zero; 0 is a ReLU, as in the
            reference implementation. After a max pool, narrow layers with a ReLU can hide an object
            completely, and then receive no gradient from it.
        vector_keys: keys of vectors in the observation that join the features of the image, such
            as "proprio"; none in the paper.
    """

    control: ClassVar[Control] = "close_loop"
    image_keys: ClassVar[tuple[str, ...]] = (keys.DEPTH,)

    precision: Precision = "auto"
    depth_reference: Literal["camera", "floor"] = "camera"
    depth_center_m: float = 0.0
    depth_scale_m: float = Field(default=1.0, gt=0)
    negative_slope: float = Field(default=0.0, ge=0, lt=1)
    vector_keys: list[str] = Field(default=[])

    def input_channels(self, image_channels: int) -> int:
        """Return the number of input channels of the first convolution."""
        return image_channels + (1 if self.depth_reference == "camera" else 2)

    def check_images(self, spec: ActorCriticSpec) -> None:
        """Refuse images that are not depth or height, nothing below zero, in one channel."""
        for key, image in spec.images.items():
            if image.channels != 1 or image.low < 0:
                raise ValueError(
                    f"{key} has {image.channels} channels with values from {image.low:g}; this "
                    "network takes depth or height in one channel, nothing below zero: choose "
                    "another view_type"
                )
