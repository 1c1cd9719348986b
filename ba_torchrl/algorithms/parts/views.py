"""Random views of sampled images: crops (RAD, FERM) and shifts (DrQ)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from ba_torchrl.core.config import MAX_PIXELS, Part

if TYPE_CHECKING:
    from torchrl.envs import Transform

    from ba_torchrl.core.images import ImageSpec


class _Whole(Part):
    """Views of the images' size."""

    def seen(self, images: Mapping[str, ImageSpec]) -> Mapping[str, ImageSpec]:
        """Return the declarations of the images that the networks see, of those that are stored."""
        return images

    def acting(self, images: Iterable[str]) -> list[Transform]:
        """Return the transforms of the images of the acting policy, by their keys."""
        return []


class NoViews(_Whole):
    """The images as they are."""

    name: Literal["none"] = "none"
    loss_options: ClassVar[dict[str, Any]] = {}

    def build(self, *args: Any, **options: Any) -> list[Transform]:
        """Return no transform of sampled transitions."""
        return []


class _Random(_Whole):
    views: int = Field(default=1, ge=1, le=100)
    """Views of each observation, over which the losses are averaged."""
    target_views: int = Field(default=1, ge=1, le=100)
    """Views of each next observation, over which the target is averaged."""

    @property
    def loss_options(self) -> dict[str, Any]:
        """Arguments of `SACfDLoss`, and of `RandomViews`."""
        return {"views": self.views, "target_views": self.target_views}

    def build(self, *args: Any, **options: Any) -> list[Transform]:
        """Return the transform of sampled transitions; arguments as for `RandomViews`."""
        from ba_torchrl.data.augmentation.views import RandomViews

        return [RandomViews(*args, **self.loss_options, **options)]


class Crop(_Random):
    """A part of the image; acting takes its centre."""

    name: Literal["crop"] = "crop"
    size: int = Field(default=128, ge=1, le=MAX_PIXELS)
    """Rows and columns, pixels."""

    def seen(self, images: Mapping[str, ImageSpec]) -> dict[str, ImageSpec]:
        """Return the declarations of the crops; `ConfigError` if an image is not larger than its
        crop."""
        from ba_torchrl.data.augmentation.views import cropped_images

        return cropped_images(images, self.size)

    def acting(self, images: Iterable[str]) -> list[Transform]:
        """Return the transform to the centre."""
        from ba_torchrl.data.augmentation.views import CenterCrop

        return [CenterCrop(self.size, list(images))]

    def build(self, *args: Any, **options: Any) -> list[Transform]:
        return super().build(*args, size=self.size, **options)


class Shift(_Random):
    """The image moved by some pixels, with its border repeated."""

    name: Literal["shift"] = "shift"
    pixels: int = Field(default=4, ge=1, le=MAX_PIXELS)
    """Largest shift; that of Kostrikov et al. (2021)."""

    def build(self, *args: Any, **options: Any) -> list[Transform]:
        return super().build(*args, padding=self.pixels, **options)


Views = Annotated[NoViews | Crop | Shift, Field(discriminator="name")]
