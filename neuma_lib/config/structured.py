"""Settings of laws with the structure of a material, and of how their correction is chosen."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section


class StructuredConfig(Section):
    """Correction of an analytic law by structured networks: which parts of the law it may change."""

    form: Literal["stretch", "energy"] = Field(
        "stretch",
        description="elastic correction: stresses ordered as the stretches, or the derivative of an energy",
    )
    held_out: float = Field(0.25, gt=0, lt=1, description="part of the frames that corrections are judged by")
    blocks: int = Field(
        4,
        ge=1,
        description="the video is cut into so many equal parts, and the last frames of each are held out. With one the "
        "correction has to foretell strains that it has not seen",
    )
    trial_iterations: int = Field(
        10,
        ge=1,
        description="optimiser steps of all parts' corrections together, without the held-out frames, before the parts "
        "are judged; `training.iterations` more follow on all frames, of those that are chosen",
    )
    margin: float = Field(
        0.05,
        ge=0,
        description="what a part of the law must gain to be corrected: the loss of the held-out frames falls by this "
        "part of itself",
    )
    rivals: int = Field(
        1,
        ge=0,
        description="so many of the families that tie with the identified one, and flow otherwise, are corrected for a "
        "trial, too; the held-out frames choose between the corrections",
    )
    penalties: tuple[float, ...] = Field(
        (),
        description="weights of `training.penalty` that are tried beside it, each for as many steps as a trial: of "
        "those that the held-out frames do as well with, the largest is taken",
    )
