"""Settings of what other programs get of a motion."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section


class ExportsConfig(Section):
    """Files in `results/<scene>/<method>/export/` ([exports](splats.md))."""

    rotate_harmonics: bool = Field(
        True,
        description="whether the spherical harmonics of exported Gaussians turn with the body, so that its shine is "
        "painted on; renders of this project leave them as they are",
    )
    size: int = Field(480, ge=32, description="width of export/motion.mp4 and .gif [px]")
