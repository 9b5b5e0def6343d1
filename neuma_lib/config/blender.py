"""Settings of Blender: appearance of objects, sizes of image sets, processes."""

from typing import Annotated, Literal

from pydantic import Field

from neuma_lib.config.base import Section, internal


class AppearanceConfig(Section):
    """Appearance of an object in Blender."""

    kind: Literal["solid", "grains", "liquid"] = Field(
        "solid", description="textured mesh, grains, or the surface of a liquid"
    )
    colors: dict[str, Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")]] = Field(
        description="part of the shape -> sRGB colour '#rrggbb'; 'body' for all other parts"
    )
    accent: str = Field(
        "",
        pattern="^(#[0-9a-fA-F]{6})?$",
        description="colour of the patches on the body; on other parts, and if empty, a darker shade",
    )
    contrast: float = Field(0.5, ge=0, le=1, description="strength of the patches")
    scale: float = internal(0.045, "size of the patches [m]", gt=0)
    seed: int = internal(0, "seed of the patches")


class ImagesConfig(Section):
    """One set of Blender renders."""

    views: int = Field(gt=0, description="number of cameras")
    width: int = Field(128, ge=8, description="image width [px]")
    height: int = Field(128, ge=8, description="image height [px]")
    samples: int = Field(16, ge=1, description="Cycles samples per pixel, denoised")


class BlenderConfig(Section):
    """Rendering processes, one for each image set."""

    device: Literal["cpu", "auto", "cuda"] = Field(
        "cpu",
        description="CPU (reproducible to the byte), a CUDA GPU, or `auto`: CUDA if the top-level `device` is not cpu, "
        "there is a GPU, and Blender has machine code for it",
    )
    threads: int = Field(1, ge=1, description="CPU cores of each process")
