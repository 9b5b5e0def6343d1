"""Settings of captures: `captures` of the project, and the capture.yaml of each capture."""

from pathlib import PurePosixPath, PureWindowsPath
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from neuma_lib.config.base import Section, Seed, internal
from neuma_lib.config.board import BoardConfig
from neuma_lib.config.scenes import MAX_BODIES
from neuma_lib.config.variants import NAME


def _inside(name: str) -> str:
    """A relative path that does not leave its folder."""
    plain = PurePosixPath(name.replace("\\", "/"))
    if not name.strip() or not name.isprintable():
        raise ValueError("expected the name of a file or folder")
    if plain.is_absolute() or PureWindowsPath(name).drive or ".." in plain.parts or name.startswith("~"):
        problem = "the path must be relative and inside the folder of the capture. Copy the file there"
        raise ValueError(problem)
    return name


Inside = Annotated[str, AfterValidator(_inside)]
Pixel = tuple[float, float]
Rectangle = tuple[float, float, float, float]


class LengthConfig(Section):
    """A known length between two marked points, or between the cameras of two photographs. It replaces the board."""

    metres: float = Field(gt=0, description="the length [m]")
    deviation: float = Field(0.0, ge=0, description="its standard deviation [m], for the report")
    cameras: tuple[str, str] | None = Field(
        None,
        description="two photographs; the length is that between their cameras, as the free flight measures it by "
        "gravity",
    )
    ends: dict[str, tuple[Pixel, Pixel]] = Field(
        {},
        description="photograph -> (x, y) of both points [px], from the upper left corner of the displayed picture; in "
        "two photographs or more, or in one if both points are on the floor",
    )

    @model_validator(mode="after")
    def _between_two_objects(self) -> "LengthConfig":
        if bool(self.ends) == (self.cameras is not None):
            raise ValueError("ends: mark the two points in photographs, or name two photographs as `cameras`")
        return self


class CameraConfig(Section):
    """A fixed video camera, named as its files `videos/<camera>.mp4` and `stills/<camera>.jpg`."""

    rate: float | None = Field(
        None,
        gt=0,
        description="recorded frame rate [1/s]; null: from the time stamps, or the recording rate stored in a "
        "slow-motion file",
    )
    offset: float | None = Field(
        None,
        description="time added to synchronise it with the first camera [s]; null: estimated from sound or motion, and "
        "refined by the free flight",
    )
    row_time: float = Field(0.0, ge=0, lt=1e-3, description="rolling shutter: time between rows [s]")
    exposure: float = Field(
        0.0, ge=0, lt=0.1, description="exposure time of a frame [s], for motion blur; 0: no motion blur"
    )


class ThrowConfig(Section):
    """One take, a launch or drop filmed by some of the cameras."""

    folder: Inside = Field(description="folder with a video of each camera, `<camera>.mp4`")


class LabelledBodyConfig(Section):
    """One of several bodies of a capture, by its label in the masks."""

    label: Annotated[int, Field(ge=1, le=255)] | Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")] = Field(
        description="its pixels in all masks: grey value or palette index from 1, or colour as '#ff0000'"
    )
    capture: str | None = Field(
        None,
        description="another capture, with photographs of this body alone; null: the photographs of this one show it",
    )
    density: float = Field(1000.0, gt=0, description="its mass density [kg/m^3]")


class CaptureConfig(Section):
    """Settings of one capture, `captures/<name>/capture.yaml`: what photographs and videos do not contain."""

    board: BoardConfig | None = Field(
        None, description="the printed board; it defines scale, floor and the vertical"
    )
    length: LengthConfig | None = Field(
        None,
        description="a known length, which defines the scale without a board; the floor is fitted; without both, "
        "the free flight states the length to enter",
    )
    photographs: Inside = Field("photos", description="folder of the photographs, all of one camera and zoom")
    stills: Inside = Field(
        "stills",
        description="folder with a picture of the empty scene for each camera, `<camera>.jpg` or .png",
    )
    throws: dict[str, ThrowConfig] = Field(
        {}, description="takes by name; empty: the videos in `videos`, or one take for each folder in it"
    )
    cameras: dict[str, CameraConfig] = Field({}, description="cameras by name")
    poses: Inside = Field(
        "photographs",
        description="camera poses: `photographs`, from all pictures together; `board`, from the board in each picture; "
        "or a transforms.json in metres, y up, floor at y = 0",
    )
    lens: Inside | None = Field(
        None,
        description="file with the intrinsics of cameras and of `photographs` (docs/capture.md), required for "
        "poses: board; null: estimated from the photographs",
    )
    masks: Inside = Field(
        "masks",
        description="folder of own masks, `photographs/<photograph>.png` and `<take>/<camera>/<frame>.png`; optional",
    )
    object: dict[str, Rectangle | Pixel] = Field(
        {},
        description="photograph -> (x0, y0, x1, y1) of a tight box around the whole object, or (x, y) of a point in "
        "its middle [px], from the upper left corner of the displayed picture; needed if other objects are around; "
        "one is enough",
    )
    bodies: dict[str, LabelledBodyConfig] = Field(
        {},
        description="two to five bodies by name that touch each other in the videos, labelled in own masks",
    )
    center: Pixel | None = Field(
        None,
        description="point on the floor at the middle of the simulated box [m], from the lower left corner of the "
        "squares, x right and y up the page; null: the middle of the board",
    )
    scale: float = Field(
        1.0, gt=0, description="metres of the simulator per metre of the room, for takes that leave the box"
    )
    longest: int = internal(
        1000, "maximum length of the longer side of the undistorted pictures [px]", ge=64, le=8192
    )
    seed: Seed = internal(0, "seed of the search for camera poses")
    prior: str = Field(
        "jelly", description="prior of the law: a name in priors.laws, or a path as for a scene"
    )
    density: float = Field(
        1000.0,
        gt=0,
        description="mass density [kg/m^3], from weight and volume; motion determines only stiffness over density",
    )
    dt: float = Field(5e-4, gt=0, lt=0.01, description="time step of the simulation [s]")
    grid: int | None = Field(
        None, ge=8, description="grid cells along each side of the simulated box; null: `captures.grid`"
    )
    held_out: tuple[str, ...] = Field((), description="takes for evaluation only, not for training")
    duration: float = Field(0.7, gt=0, description="used part of a video, from the start of the flight [s]")
    frames: int = internal(60, "maximum number of training frames of a camera, evenly spaced", ge=8)
    width: int = internal(160, "longer side of the training images [px]", ge=32, le=2048)

    @property
    def metric(self) -> bool:
        """Whether the settings define the scale. Otherwise gravity in a video measures it."""
        return self.poses != "photographs" or self.board is not None or self.length is not None

    @model_validator(mode="after")
    def _metres_from_somewhere(self) -> "CaptureConfig":
        if self.board is None and self.poses == "board":
            problem = "poses: board needs `board: {square: ...}` with the measured side of a square [m]"
            raise ValueError(problem)
        if self.board is not None and self.length is not None:
            raise ValueError("length: the board already defines the scale; give one of the two")
        if self.center is not None and (self.board is None or self.poses not in ("photographs", "board")):
            problem = "center: it is a point in the frame of the board, which is not used here; leave it out"
            raise ValueError(problem)
        if len(self.bodies) not in (0, *range(2, MAX_BODIES + 1)):
            raise ValueError(f"bodies: {len(self.bodies)} must be 2 to {MAX_BODIES}")
        labels = [str(body.label).lower() for body in self.bodies.values()]
        for body, label in zip(self.bodies, labels, strict=True):
            if not NAME.fullmatch(body):
                raise ValueError(f"bodies.{body}: a name has letters, digits, - and _")
            if labels.count(label) > 1:
                raise ValueError(f"bodies.{body}.label: another body has the label {label} as well")
        if len({label.startswith("#") for label in labels}) > 1:
            raise ValueError("bodies: labels must be all numbers or all colours")
        if self.bodies and (self.object or self.density != 1000.0):
            raise ValueError("object, density: of one body only; `bodies` have labels and densities instead")
        for name, mark in self.object.items():
            if len(mark) == 4 and (mark[2] - mark[0] < 8 or mark[3] - mark[1] < 8):
                problem = f"object.{name}: expected [left, upper, right, lower] in pixels, 8 apart or more"
                raise ValueError(problem)
        if self.poses == "board" and self.lens is None:
            raise ValueError("poses: board needs `lens`, a file with the intrinsics of the cameras")
        return self


class ReleasedConfig(Section):
    """A capture of Spring-Gaus, or the copy of one by NeuMA's authors."""

    folder: str = Field(
        description="`real_capture` of Spring-Gaus with all objects, or NeuMA's folder of the object"
    )
    object: str | None = Field(None, description="name of the object in the files; null: that of the capture")
    photographs: str | None = Field(
        None, description="`real_capture` of Spring-Gaus, if `folder` is NeuMA's, which has no photographs"
    )
    ground: float | None = Field(
        None, description="z of the floor in the world of the files; null: as in Spring-Gaus"
    )
    scale: float = Field(
        0.75,
        gt=0,
        description="metres per unit of the files, which are not metric: free fall is 1.33 times too fast. "
        "`flight/first.json` has the value that the frames before contact give",
    )
    enlarge: float = internal(
        2.5, "metres of the simulator per metre, `scale` in capture.yaml; for objects of 10 cm", gt=0
    )
    contact: int | None = internal(None, "frame of the first contact; null: from the files, or 5", ge=5)
    prior: str = Field("jelly", description="as in capture.yaml")
    density: float = internal(1000.0, "as in capture.yaml [kg/m^3]", gt=0)
    dt: float = internal(1 / 1920, "time step [s], a sixteenth of a frame of 1/120 s", gt=0, lt=0.01)
    grid: int | None = internal(None, "as in capture.yaml", ge=8)
    longest: int = internal(1000, "longer side of the stored photographs [px]", ge=64, le=8192)
    width: int = internal(160, "as in capture.yaml [px]", ge=32, le=2048)

    def as_capture(self) -> CaptureConfig:
        """The equivalent capture.yaml."""
        same = ("prior", "density", "dt", "grid", "longest", "width")
        return CaptureConfig(
            poses="released", scale=self.enlarge, **{key: getattr(self, key) for key in same}
        )


class CapturesConfig(Section):
    """Own photographs and videos ([guide](capture.md))."""

    root: str = Field("captures", description="folder with a folder for each capture")
    grid: int = Field(
        48,
        ge=8,
        description="grid cells along each side of the simulated box, if a capture has no own value; 14 cells across "
        "an object of 0.3 m",
    )
    paper: Literal["A4", "A3"] = Field("A4", description="page of the printed board")
    released: dict[str, ReleasedConfig] = Field(
        {}, description="captures of Spring-Gaus and NeuMA by name; each has the scene `<name>_first`"
    )
    printed: BoardConfig = Field(BoardConfig(square=0.030), description="the board to print")
    shown: int = internal(320, "longer side of the pictures in reports [px]", ge=64, le=2048)
    measured: int = internal(20, "maximum number of frames of a camera that a report measures", ge=1)
