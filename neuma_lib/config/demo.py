"""Settings of the demo and of films."""

from pydantic import Field

from neuma_lib.config.base import Section, internal


class DemoConfig(Section):
    """The demo, `make demo`: one scene from its images to a film of the learned motion."""

    scene: str = Field("BouncyBall", description="scene of the demo")
    methods: tuple[str, ...] = Field(
        ("nclaw", "neuma"),
        min_length=1,
        description="methods next to the video in `film.mp4` and `film.gif` of every scene; the demo exports the law "
        "of the last one",
    )
    titles: dict[str, str] = Field({}, description="names of methods in the film, if not their own")
    magnify: int = internal(2, "enlargement of the film", ge=1)
