"""Settings of the figures."""

from typing import ClassVar

from pydantic import Field

from neuma_lib.config.base import Section, internal


class FiguresConfig(Section):
    """Content of the figures. They compare the methods of tables.table1, unless a key here lists methods."""

    # Keys that name scenes or experiments.
    SHOWN: ClassVar[dict[str, str]] = {
        **dict.fromkeys(("main_res", "particles_app", "lora_alphav", "gradient_analysis"), "scene"),
        **dict.fromkeys(("pipeline", "material_response", "obstacles"), "scene"),
        "i23d": "scene",
        **dict.fromkeys(("letters", "meetings", "ext_time"), "experiment"),
    }

    magnify: int = Field(3, ge=1, description="enlargement of renders by the cameras of the videos")
    size: int = Field(
        288, ge=32, description="width of renders by other cameras, of experiments and particles [px]"
    )
    view: int = internal(0, "view of the videos", ge=0)
    shown: int = internal(5, "frames of a sequence; more for one object, fewer for many", ge=3)
    main_res: tuple[str, ...] = Field(
        ("BouncyBall", "RubberPawn", "ClayCat"), min_length=1, description="scenes of the renders over time"
    )
    particles_app: str = internal("JellyDuck", "scene whose particles are shown for all methods")
    lora_alphav: tuple[str, ...] = internal(
        ("BouncyBall", "RubberPawn"), "scenes of the interpolation", min_length=1
    )
    methods: tuple[str, ...] = Field(
        ("neuma", "neuma_structured"),
        min_length=1,
        description="trained methods with a row in ext_time and a figure in vis_generalize and lora_alphav",
    )
    beside: tuple[str, ...] = Field(
        (),
        description="methods added to those of tables.table1 in ch_dist_curve, image_quality and main_res, for example "
        "other systems (docs/systems.md)",
    )
    weights: tuple[float, ...] = internal(
        (0.0, 0.25, 0.5, 0.75, 1.0, 1.25), "weights w of the adaptor, in order", min_length=1
    )
    letters: tuple[str, ...] = Field((), description="experiments with one letter each, in order")
    meetings: tuple[str, ...] = Field((), description="experiments with several objects")
    ext_time: str = Field("", description="experiment that is longer than the video of its scene")
    i23d: tuple[str, ...] = internal(
        ("JellyDuck", "ClayCat", "HoneyBottle"),
        "scenes whose laws, learned by the first of `methods`, move all splats",
        min_length=1,
    )
    realworld: tuple[str, ...] | None = internal(
        None, "captures in that figure; null: captures.released, else the demo captures", min_length=1
    )
    realworld_methods: tuple[str, ...] = internal(
        ("spring_gaus", "neuma"), "methods next to the videos of realworld", min_length=1
    )
    gradient_analysis: tuple[str, ...] = internal(
        ("BouncyBall", "RubberPawn"), "scenes of the gradient norms", min_length=1
    )
    pipeline: str = internal("ClayCat", "scene that is shown through all stages")
    material_response: tuple[str, ...] = internal(
        ("BouncyBall", "JellyDuck", "RubberPawn", "ClayCat", "SandFish", "HoneyBottle"),
        "scenes of the tests of material points",
        min_length=1,
    )
    pile: str | None = internal(
        None, "experiment with some of the bodies of a scene of several; null: no figure"
    )
    obstacles: tuple[str, ...] = internal(
        ("JellyStair", "ClayPress", "SandGlass"),
        "scenes with colliders whose true motions are shown",
        min_length=1,
    )
    shear_rate: float = internal(20.0, "shear rate of the yield test [1/s]", gt=0)
    total_shear: float = internal(0.6, "final shear of the yield test", gt=0)
