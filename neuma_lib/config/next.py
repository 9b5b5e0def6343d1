"""Settings of the choice of the next experiment."""

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section, internal


class NextConfig(Section):
    """Candidates for the next experiment with an object, and what the lab can do."""

    kinds: tuple[Literal["launch", "turned", "press", "hang", "camera"], ...] = Field(
        ("launch", "turned", "hang", "camera"),
        min_length=1,
        description="launch: another initial motion of the object; turned: also another orientation at the start; "
        "hang: from a clamp around its upper part; camera: a second camera for the first video; press: a platen from "
        "above, whose constants have larger errors than expected",
    )
    max_height: float = Field(
        0.7, gt=0, description="maximum initial y of the centre of the bounding box [m]"
    )
    max_speed: float = Field(
        3.0, ge=0, description="maximum speed at the start, and of the platen and the clamp [m/s]"
    )
    max_spin: float = Field(5.0, ge=0, description="maximum initial angular speed [rad/s]; 0: no spin")
    predict: str | None = Field(
        None,
        description="experiment with one body of the material, whose motion shall be predicted as accurately as "
        "possible; null: candidates are ranked by the constants of the material",
    )
    candidates: int = internal(40, "number of candidates", ge=1, le=500)
    rivals: int = internal(
        1, "other families to distinguish, those with the lowest scores, and all that predict as well", ge=0
    )
