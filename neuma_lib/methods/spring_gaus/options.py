"""Settings of bodies of springs (Spring-Gaus)."""

from pydantic import Field

from neuma_lib.config.base import Section, internal


class SpringsConfig(Section):
    """A network of springs between anchors in the body (Spring-Gaus). Published values are in brackets."""

    anchors: int = Field(
        400, ge=4, description="particles of the body that are anchors, far from each other (2048)"
    )
    neighbours: int = internal(48, "springs of an anchor, to the nearest anchors (256)", ge=1)
    hard_springs: int = internal(8, "nearest springs that always have full stiffness (16)", ge=0)
    exponent: float = internal(0.5, "p of the factor (1 + |strain|)^p of a spring's force", ge=0)
    guess: float = internal(2.0e5, "initial Young's modulus of all springs [Pa]", gt=0)
    resistance: float = internal(0.1, "initial damping c along the springs [m/s]", gt=0)
    learn_resistance: bool = internal(False, "whether the damping is learned")
    carriers: int = internal(16, "nearest anchors that a particle or tracer follows", ge=4)
    truncated: bool = internal(
        False, "true: a step per frame, by the gradient since the previous frame (published)"
    )
    lr_springs: float = internal(
        0.05, "learning rate of log10 stiffness, softness and friction (0.001)", gt=0
    )
    gap: float = internal(0.0, "initial distance inside the walls at which anchors stop [m]")
    learn_gap: bool = internal(True, "whether the gap is learned (no); walls of a grid are not sharp")
    substeps: int = internal(1, "minimum number of substeps of a time step; stiff springs need more", ge=1)
