"""Settings of the board that is printed for captures."""

from typing import Literal, Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, internal

PAPERS = {"A4": (0.210, 0.297), "A3": (0.297, 0.420)}  # width and height of a page [m]


class BoardConfig(Section):
    """The printed ChArUco board."""

    square: float = Field(gt=0.002, lt=0.5, description="side of a square, measured on the print [m]")
    squares: tuple[int, int] = Field((6, 8), description="squares along width and height of the page")
    marker: float = internal(0.75, "side of a marker [squares]", ge=0.4, le=0.9)
    dictionary: Literal["DICT_4X4_100", "DICT_5X5_100", "DICT_6X6_100", "DICT_APRILTAG_36h11"] = internal(
        "DICT_5X5_100", "dictionary of markers, as OpenCV names it"
    )
    thickness: float = Field(
        0.0, ge=0, lt=0.1, description="height of the print above the floor, for example on a panel [m]"
    )

    @model_validator(mode="after")
    def _markers_suffice(self) -> Self:
        columns, rows = self.squares
        if min(columns, rows) < 3 or columns * rows > 200:
            raise ValueError("squares: expected at least 3 in each direction, and at most 200 in total")
        return self
