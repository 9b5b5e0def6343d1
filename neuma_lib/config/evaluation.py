"""Settings of measures and videos."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section


class EvaluationConfig(Section):
    """Rollout of the learned law and its measures."""

    tracers: int = Field(
        100_000, gt=0, description="passive tracers in the prediction, as many as dataset.tracers"
    )
    views: tuple[int, ...] | None = Field(
        None,
        min_length=1,
        description="views of the image metrics; null: those that training does not see. Where there are none, those "
        "that `training.views` leaves out are taken, or else the training views, and results and figures say so",
    )
    margin: float = Field(
        0.1,
        ge=0,
        description="image metrics look at the bounding box of the object, observed and predicted, widened on each "
        "side by this fraction of its longer side",
    )
    states: int = Field(
        2000,
        ge=1,
        description="states of the true motion, drawn as they occur, that stresses are compared on",
    )
    paths: int = Field(
        250, ge=1, description="particles along whose true motion stresses are compared, at most all of them"
    )
    video_view: int = Field(0, ge=0, description="view of the mp4 of prediction beside observation")
    frame_rate: int = Field(12, ge=1, description="frames a second of the mp4")
    video_magnify: int = Field(3, ge=1, description="enlargement of the mp4's pixels")
