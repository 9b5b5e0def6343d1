"""Settings of structured corrections of analytic laws."""

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section, internal


class StructuredConfig(Section):
    """Correction of an analytic law by structured networks."""

    form: Literal["stretch", "energy"] = Field(
        "stretch",
        description="elastic correction: stresses ordered as the stretches, or the gradient of an energy",
    )
    held_out: float = internal(0.25, "share of the frames on which corrections are compared", gt=0, lt=1)
    # With one block, a correction must extrapolate to strains that it has not seen.
    blocks: int = internal(4, "equal parts of the video, of each of which the last frames are held out", ge=1)
    # `training.iterations` follow on all frames, for the selected parts.
    trial_iterations: int = internal(10, "optimiser steps before the parts are selected", ge=1)
    margin: float = internal(
        0.05, "relative decrease of the held-out loss required to correct a part of the law", ge=0
    )
    rivals: int = internal(
        1, "number of tied families with another return map that are corrected for comparison", ge=0
    )
