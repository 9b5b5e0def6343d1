"""Settings of the figures."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from neuma_lib.config.base import Section


class FiguresConfig(Section):
    """What the figures show. Methods that a figure compares are those of tables.table1, but for those of `methods`."""

    # Keys that name scenes or experiments.
    SHOWN: ClassVar[dict[str, str]] = {
        **dict.fromkeys(("main_res", "particles_app", "lora_alphav", "gradient_analysis"), "scene"),
        **dict.fromkeys(("pipeline", "material_response"), "scene"),
        "i23d": "scene",
        **dict.fromkeys(("letters", "meetings", "ext_time"), "experiment"),
    }

    magnify: int = Field(
        3, ge=1, description="enlargement of the cameras of the videos for renders in figures"
    )
    size: int = Field(
        288,
        ge=32,
        description="width of pictures that have a camera of their own (experiments, particles) [px]",
    )
    view: int = Field(0, ge=0, description="view of the videos that is shown")
    shown: int = Field(
        5, ge=3, description="frames of a sequence, more in figures of one object, fewer of many"
    )
    main_res: tuple[str, ...] = Field(
        ("BouncyBall", "RubberPawn", "ClayCat"), min_length=1, description="scenes of the renders over time"
    )
    particles_app: str = Field("JellyDuck", description="scene whose particles are shown under all methods")
    lora_alphav: tuple[str, ...] = Field(
        ("BouncyBall", "RubberPawn"), min_length=1, description="scenes of the interpolation"
    )
    methods: tuple[str, ...] = Field(
        ("neuma", "neuma_structured"),
        min_length=1,
        description="trained laws at work elsewhere: a row each in ext_time, a figure each of vis_generalize and "
        "lora_alphav, from the second on with the method's name behind it",
    )
    beside: tuple[str, ...] = Field(
        (),
        description="further methods, beside those of tables.table1, in ch_dist_curve, image_quality and main_res: "
        "other systems (docs/systems.md), which are fitted then",
    )
    weights: tuple[float, ...] = Field(
        (0.0, 0.25, 0.5, 0.75, 1.0, 1.25), min_length=1, description="weights w of the adaptor, in order"
    )
    letters: tuple[str, ...] = Field((), description="experiments with one letter each, in order")
    meetings: tuple[str, ...] = Field((), description="experiments with several objects")
    ext_time: str = Field("", description="experiment that goes on after its scene's video ends")
    i23d: tuple[str, ...] = Field(
        ("JellyDuck", "ClayCat", "HoneyBottle"),
        min_length=1,
        description="scenes whose laws move all splats among the scenes, learned there by the first of `methods`",
    )
    realworld: tuple[str, ...] | None = Field(
        None,
        min_length=1,
        description="captures in the figure of filmed objects, each by the throw that its law is learned from; null: "
        "those of `captures.released`, or else the demo captures",
    )
    realworld_methods: tuple[str, ...] = Field(
        ("spring_gaus", "neuma"), min_length=1, description="methods beside the videos of these"
    )
    gradient_analysis: tuple[str, ...] = Field(
        ("BouncyBall", "RubberPawn"), min_length=1, description="scenes of the gradient norms"
    )
    pipeline: str = Field("ClayCat", description="scene that is shown through all stages")
    material_response: tuple[str, ...] = Field(
        ("BouncyBall", "JellyDuck", "RubberPawn", "ClayCat", "SandFish", "HoneyBottle"),
        min_length=1,
        description="scenes of the tests of material points",
    )
    shear_rate: float = Field(20.0, gt=0, description="rate of shear of the test of yielding [1/s]")
    total_shear: float = Field(0.6, gt=0, description="amount of shear that the test of yielding ends at")
