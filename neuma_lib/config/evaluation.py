"""Settings of measures and videos."""

from pydantic import Field

from neuma_lib.config.base import Section, internal


class EvaluationConfig(Section):
    """Rollout of the learned law and its measures."""

    tracers: int = Field(
        100_000, gt=0, description="passive tracers in the prediction, equal to dataset.tracers"
    )
    views: tuple[int, ...] | None = Field(
        None,
        min_length=1,
        description="views of the image metrics; null: views outside the training, else outside `training.views`, else "
        "the training views, with a note in results and figures",
    )
    margin: float = internal(
        0.1,
        "margin of the crop for image metrics around the object, observed and predicted, as a fraction of "
        "the longer side",
        ge=0,
    )
    states: int = internal(2000, "states of the true motion on which stresses are compared", ge=1)
    paths: int = internal(250, "maximum number of particles along whose motion stresses are compared", ge=1)
    video_view: int = internal(0, "view of the mp4 of prediction and observation", ge=0)
    frame_rate: int = Field(12, ge=1, description="frame rate of the mp4 [1/s]")
    video_magnify: int = Field(3, ge=1, description="enlargement of the mp4")
