"""Settings of the first minute: `make demo`."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section


class DemoConfig(Section):
    """One scene, from nothing to a film of what was learned."""

    scene: str = Field("BouncyBall", description="scene that is learned")
    methods: tuple[str, ...] = Field(
        ("nclaw", "neuma"),
        min_length=1,
        description="methods beside the video in the films `results/<scene>/film.mp4` and `film.gif` of any scene; the "
        "law of the last one is exported",
    )
    titles: dict[str, str] = Field({}, description="names of methods in the film, in place of their own")
    magnify: int = Field(2, ge=1, description="enlargement of the film's pictures")
