"""Settings of motions exported to other programs."""

from pydantic import Field

from neuma_lib.config.base import Section, internal


class ExportsConfig(Section):
    """Files in `results/<scene>/<method>/export/` ([exports](splats.md))."""

    rotate_harmonics: bool = internal(
        True, "rotate the spherical harmonics of exported Gaussians with the body; renders here do not"
    )
    size: int = Field(480, ge=32, description="width of export/motion.mp4 and .gif [px]")
