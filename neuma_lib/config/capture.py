"""Settings of captures: the board that is printed for them, and the capture.yaml of each."""

from __future__ import annotations

from pathlib import PurePosixPath, PureWindowsPath
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from neuma_lib.config.base import Section
from neuma_lib.config.board import BoardConfig


def _inside(name: str) -> str:
    """A path as the settings have it: relative, and not above the folder that it starts from."""
    plain = PurePosixPath(name.replace("\\", "/"))
    if not name.strip() or not name.isprintable():
        raise ValueError("expected the name of a file or folder")
    if plain.is_absolute() or PureWindowsPath(name).drive or ".." in plain.parts or name.startswith("~"):
        raise ValueError(
            "a path must stay in the capture's folder: copy the file there, and name it from there"
        )
    return name


Inside = Annotated[str, AfterValidator(_inside)]
Pixel = tuple[float, float]


class LengthConfig(Section):
    """A length between two points that are marked in photographs, where no board was laid."""

    metres: float = Field(gt=0, description="distance between the points [m]")
    ends: dict[str, tuple[Pixel, Pixel]] = Field(
        description="photograph -> (x, y) of the first and of the second point [px], from its left upper corner; the "
        "same two points in at least two photographs"
    )

    @model_validator(mode="after")
    def _seen_twice(self) -> LengthConfig:
        if len(self.ends) < 2:
            raise ValueError("ends: mark the two points in at least two photographs")
        return self


class CameraConfig(Section):
    """One fixed video camera, by the name of its files: `videos/<camera>.mp4` and `stills/<camera>.jpg`."""

    rate: float | None = Field(
        None,
        gt=0,
        description="frames a second that were really filmed; null: the file's time stamps, or the rate of filming "
        "that a slow-motion file names",
    )
    offset: float | None = Field(
        None,
        description="what is added to its times to make them those of the first camera, by name [s]; null: found from "
        "sound or motion, and refined by the free flight",
    )
    row_time: float = Field(
        0.0, ge=0, lt=1e-3, description="time from row to row of a rolling shutter [s]; 0: all rows at once"
    )
    exposure: float = Field(
        0.0,
        ge=0,
        lt=0.1,
        description="how long a frame is exposed [s], for motion blur; its time is the middle. 0: blur is left out",
    )


class ThrowConfig(Section):
    """One throw or drop, filmed by all cameras or by some of them."""

    folder: Inside = Field(description="folder with a video for each camera, `<camera>.mp4`")


class CaptureConfig(Section):
    """Own photographs and videos of one object, in `captures/<name>/`: what they cannot tell themselves."""

    board: BoardConfig | None = Field(
        None, description="the printed board; it gives metres, the floor and where down is"
    )
    length: LengthConfig | None = Field(
        None,
        description="a stated length, which gives metres where there is no board; the floor is fitted then",
    )
    photographs: Inside = Field("photos", description="folder of the photographs, all of one camera and zoom")
    stills: Inside = Field(
        "stills",
        description="folder with a picture of the empty scene for each camera, `<camera>.jpg` or .png",
    )
    throws: dict[str, ThrowConfig] = Field(
        {}, description="throws by name; none: the videos in `videos`, or one throw for each folder in it"
    )
    cameras: dict[str, CameraConfig] = Field(
        {}, description="what the files of a camera do not say, by its name"
    )
    poses: Inside = Field(
        "photographs",
        description="how the cameras are found: `photographs`, from all pictures together; `board`, from the board in "
        "each picture; or a transforms.json that has them, in metres, y up, the floor at y = 0",
    )
    lens: Inside | None = Field(
        None,
        description="file with the intrinsics of cameras, by name, `photographs` among them (docs/capture.md); needed "
        "for poses: board; null: found from the photographs",
    )
    masks: Inside = Field(
        "masks",
        description="folder of own masks, which are taken as they are: `photographs/<photograph>.png`, "
        "`<throw>/<camera>/<frame>.png`; it need not exist",
    )
    center: Pixel | None = Field(
        None,
        description="the place on the floor that becomes the middle of the simulator's box, in the board's frame: x "
        "right, y up the page from the left lower corner of the squares [m]; null: the middle of the board",
    )
    scale: float = Field(
        1.0, gt=0, description="metres of the simulator to a metre of the room, for throws that leave the box"
    )
    longest: int = Field(
        1000,
        ge=64,
        le=8192,
        description="longer side of the undistorted pictures, which are never enlarged [px]",
    )
    seed: int = Field(0, ge=0, description="of the search for camera poses")
    prior: str = Field(
        "jelly", description="law that is believed in before, a name in priors.laws or a path as for a scene"
    )
    density: float = Field(
        1000.0,
        gt=0,
        description="mass density [kg/m^3], from a kitchen scale and the volume; motion tells stiffness over density "
        "alone",
    )
    dt: float = Field(5e-4, gt=0, lt=0.01, description="time step of the simulation [s]")
    grid: int | None = Field(
        None, ge=8, description="grid cells along each side of the simulator's box; null: `captures.grid`"
    )
    held_out: tuple[str, ...] = Field(
        (), description="throws that the law is not learned from, but judged on"
    )
    duration: float = Field(
        0.7, gt=0, description="how much of a video counts, from the start of the flight on [s]"
    )
    frames: int = Field(
        60, ge=8, description="most frames of a camera that the law is learned from, evenly spread"
    )
    width: int = Field(
        160, ge=32, le=2048, description="longer side of the pictures that the law is learned from [px]"
    )

    @model_validator(mode="after")
    def _metres_from_somewhere(self) -> CaptureConfig:
        if self.board is None and self.poses == "board":
            raise ValueError(
                "poses: board needs `board: {square: ...}`, the square's side as measured in metres"
            )
        if self.board is None and self.length is None and self.poses == "photographs":
            raise ValueError(
                "nothing says how large the scene is: give `board: {square: ...}`, its square's side as measured in "
                "metres, or a stated `length`"
            )
        if self.board is not None and self.length is not None:
            raise ValueError("length: the board says how long a metre is; give one of the two")
        if self.center is not None and (self.board is None or self.poses not in ("photographs", "board")):
            raise ValueError(
                "center: it is a place in the frame of the board, from which nothing is taken here; leave it out"
            )
        if self.poses == "board" and self.lens is None:
            raise ValueError("poses: board needs `lens`, a file with the cameras' intrinsics")
        return self


class ReleasedConfig(Section):
    """A capture of Spring-Gaus, or of the copy of them by NeuMA's authors: where it lies, and what is not in it."""

    folder: str = Field(
        description="`real_capture` of Spring-Gaus, with all of its objects, or NeuMA's folder of the object"
    )
    object: str | None = Field(None, description="name of the object in the files; null: that of the capture")
    photographs: str | None = Field(
        None,
        description="`real_capture` of Spring-Gaus, for its photographs, where `folder` is NeuMA's, which has none",
    )
    ground: float | None = Field(
        None, description="z of the floor in the files' world; null: as in Spring-Gaus' settings"
    )
    scale: float = Field(
        0.75,
        gt=0,
        description="metres to a unit of the files' world, which is not metric: free fall in it is reported to be 1.33 "
        "times too fast. What the frames before contact say is in `flight/first.json`",
    )
    enlarge: float = Field(
        2.5,
        gt=0,
        description="metres of the simulator to a metre, as `scale` in capture.yaml: objects of 10 cm need it on a "
        "coarse grid",
    )
    contact: int | None = Field(
        None, ge=5, description="number of the frame of the first contact; null: as the files say, or 5"
    )
    prior: str = Field("jelly", description="as in capture.yaml")
    density: float = Field(1000.0, gt=0, description="as in capture.yaml [kg/m^3]")
    dt: float = Field(1 / 1920, gt=0, lt=0.01, description="time step [s]; a frame of 1/120 s has 16 of them")
    grid: int | None = Field(None, ge=8, description="as in capture.yaml")
    longest: int = Field(
        1000, ge=64, le=8192, description="longer side of the photographs that are kept [px]"
    )
    width: int = Field(160, ge=32, le=2048, description="as in capture.yaml [px]")

    def as_capture(self) -> CaptureConfig:
        """What a capture.yaml would say of it."""
        same = ("prior", "density", "dt", "grid", "longest", "width")
        return CaptureConfig(
            poses="released", scale=self.enlarge, **{key: getattr(self, key) for key in same}
        )


class CapturesConfig(Section):
    """Own photographs and videos ([guide](capture.md)): where they lie, and the board that is printed for them."""

    root: str = Field("captures", description="folder with a folder for each capture")
    grid: int = Field(
        48,
        ge=8,
        description="grid cells along each side of the simulator's box, where a capture says nothing else: twice those "
        "of the rendered scenes, since own objects are smaller. One of 0.3 m then has 14 of them",
    )
    paper: Literal["A4", "A3"] = Field("A4", description="page that the board is printed on")
    released: dict[str, ReleasedConfig] = Field(
        {},
        description="captures of Spring-Gaus and of NeuMA's authors, by name; each makes the scene `<name>_first`",
    )
    printed: BoardConfig = Field(
        BoardConfig(square=0.030),
        description="the board as printed; what a print measures stands in capture.yaml",
    )
    shown: int = Field(
        320, ge=64, le=2048, description="longer side of the pictures that the report measures and shows [px]"
    )
    measured: int = Field(
        20, ge=1, description="most frames of a camera that the report measures, evenly spread over its video"
    )
