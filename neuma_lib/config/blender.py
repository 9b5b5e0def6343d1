"""Settings of Blender: what an object looks like, and how large sets of images are."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section


class AppearanceConfig(Section):
    """What an object looks like in Blender."""

    kind: Literal["solid", "grains", "liquid"] = Field(
        "solid", description="textured mesh, grains, or a liquid's surface"
    )
    colors: dict[str, str] = Field(
        description="part of the shape -> sRGB colour '#rrggbb'; 'body' for all others"
    )
    accent: str = Field(
        "",
        description="colour of the soft patches on the body; other parts, and all if empty, get a darker shade",
    )
    contrast: float = Field(0.5, ge=0, le=1, description="strength of the patches")
    scale: float = Field(0.045, gt=0, description="size of the patches [m]")
    seed: int = Field(0, description="seed of the patches")


class ImagesConfig(Section):
    """One set of Blender renders."""

    views: int = Field(gt=0, description="number of cameras")
    width: int = Field(128, ge=8, description="image width [px]")
    height: int = Field(128, ge=8, description="image height [px]")
    samples: int = Field(16, ge=1, description="Cycles samples a pixel (denoised)")


class BlenderConfig(Section):
    """The processes that render; each makes one image set."""

    device: Literal["cpu", "auto", "cuda"] = Field(
        "cpu",
        description="what renders: CPU cores, to the same bytes every time; a CUDA GPU, to slightly other images; "
        "or `auto`, CUDA where `device` is not cpu and there is one",
    )
    threads: int = Field(1, ge=1, description="CPU cores of each")
