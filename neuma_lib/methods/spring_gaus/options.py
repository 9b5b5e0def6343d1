"""Settings of bodies of springs (Spring-Gaus)."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section


class SpringsConfig(Section):
    """A network of springs between anchors in the body, and how it is fitted. Iterations and views are those of
    `material`. In brackets what Spring-Gaus has published."""

    anchors: int = Field(
        400, ge=4, description="particles of the body that are anchors, far from each other (2048)"
    )
    neighbours: int = Field(48, ge=1, description="springs of an anchor, to its nearest (256)")
    hard_springs: int = Field(
        8,
        ge=0,
        description="of these, the nearest, which always pull fully (16); how fast the others fade is learned",
    )
    exponent: float = Field(0.5, ge=0, description="p of the factor (1 + |strain|)^p of a spring's force")
    guess: float = Field(
        2.0e5,
        gt=0,
        description="Young's modulus that all stiffnesses start from, the same in every scene [Pa]",
    )
    resistance: float = Field(0.1, gt=0, description="damping c along the springs at the start [m/s]")
    learn_resistance: bool = Field(False, description="whether the damping is learned, too")
    carriers: int = Field(16, ge=4, description="nearest anchors that a particle or tracer follows")
    truncated: bool = Field(
        False,
        description="true: an optimiser step for every frame, by the gradient of the steps since the frame before it "
        "(published); false: one for the whole video, by its whole gradient",
    )
    lr_springs: float = Field(
        0.05,
        gt=0,
        description="learning rate of log10 stiffness, softness and friction (0.001); a tenth of it for log10 damping, "
        "0.03 of it [m] for the gap",
    )
    gap: float = Field(
        0.0,
        description="how far inside the simulator's walls anchors are stopped at the start [m]; negative: beyond",
    )
    learn_gap: bool = Field(
        True,
        description="whether this is learned, too (no: the ground is known); the walls of a grid are not sharp",
    )
    substeps: int = Field(
        1, ge=1, description="least parts of a time step; more are taken where the springs are stiff"
    )
