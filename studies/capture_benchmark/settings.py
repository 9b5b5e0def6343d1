"""Settings of the demo captures: photographs and videos that Blender takes of simulated objects in a room."""

from __future__ import annotations

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, Vector
from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.config.board import BoardConfig
from neuma_lib.config.laws import LawConfig


class LensConfig(Section):
    """A lens with radial distortion, as OpenCV has it."""

    width: int = Field(ge=64, description="of its pictures [px]")
    height: int = Field(ge=64, description="of its pictures [px]")
    focal: float = Field(gt=0, description="focal length, of square pixels [px]")
    center: tuple[float, float] = Field(
        description="principal point, from the left upper corner; multiples of 0.5 [px]"
    )
    distortion: tuple[float, float] = Field(description="k1 and k2 of Brown and Conrady")

    @model_validator(mode="after")
    def _center_is_rendered(self) -> LensConfig:
        # A picture is part of a larger one around the optical axis, which has whole pixels.
        if any(
            2 * c != round(2 * c) or not 0 < c < side
            for c, side in zip(self.center, (self.width, self.height))
        ):
            raise ValueError("center: expected multiples of 0.5 inside the picture")
        return self

    def resized(self, factor: float) -> LensConfig:
        """The lens of pictures of a size that is multiplied by a factor, but for a quarter of a pixel."""
        width, height = round(factor * self.width), round(factor * self.height)
        center = tuple(round(2 * factor * c) / 2 for c in self.center)
        changed = {"width": width, "height": height, "focal": factor * self.focal, "center": center}
        return LensConfig(**{**self.plain(), **changed})


class DemoCameraConfig(Section):
    """A fixed video camera; places are from the middle of the drop, on the floor: x right, y up, z to the front."""

    place: Vector = Field(description="where it stands [m]")
    target: Vector = Field((-0.06, 0.26, 0.0), description="centre of its picture [m]")
    lens: LensConfig = Field(description="its lens")
    late: int = Field(
        0, ge=0, description="when its first frame is taken, in steps of the truth after the start"
    )


class DemoDropConfig(Section):
    """One drop of an object."""

    turn: Vector = Field(
        description="turns about x, then y, then z of the room that take the object as photographed to the start "
        "[degrees]"
    )
    height: float = Field(0.38, gt=0, description="of its lowest point above the floor at the start [m]")
    center: tuple[float, float] = Field(
        (0.0, 0.0), description="x and z of its bounding box's centre at the start [m]"
    )
    velocity: Vector = Field(description="at the start [m/s]")
    spin: Vector = Field(description="angular velocity at the start, room's axes [rad/s]")


class DifficultiesConfig(Section):
    """What makes a capture hard. The defaults make none."""

    furniture: int = Field(
        0,
        ge=0,
        description="pieces in the room, half of them low and near the object; its box is then marked",
    )
    board: bool = Field(
        True, description="false: a ruler lies in place of the board, and its ends are marked"
    )
    row_time: float = Field(
        0.0, ge=0, lt=1e-4, description="of the videos' rolling shutter, from the top [s]"
    )
    repeats: int = Field(1, ge=1, description="how often a video file stores each picture")
    blur: float = Field(
        0.0, ge=0, description="standard deviation of the length of a photograph's motion blur [px]"
    )
    sway: float = Field(0.0, ge=0, description="standard deviation of a hand-held video camera's shift [px]")
    bystander: bool = Field(False, description="a second object rolls across the background of the videos")
    marked: float = Field(1.5, ge=0, description="standard deviation of marks that a user sets [px]")
    seed: int = Field(0, ge=0, description="of the furniture")


class DemoObjectConfig(Section):
    """An object of the demo captures."""

    shape: str = Field(description="name of the shape, as of a scene")
    size: float = Field(gt=0, description="longest side of its bounding box [m]")
    appearance: AppearanceConfig = Field(description="how Blender shows it")
    law: LawConfig = Field(description="its true material")
    density: float = Field(1000.0, gt=0, description="its mass density [kg/m^3]")
    prior: str = Field(description="law that is believed in before, as its capture.yaml has it")
    heading: float = Field(0.0, description="turn about the vertical in the photographs [degrees]")
    place: tuple[float, float] = Field(
        (0.05, 0.0), description="x and z of its bounding box's centre in the photographs [m]"
    )
    drops: dict[str, DemoDropConfig] = Field(description="drops by name")
    held_out: tuple[str, ...] = Field((), description="drops that no law is learned from")
    difficulties: DifficultiesConfig = Field(DifficultiesConfig(), description="of room and cameras")

    @model_validator(mode="after")
    def _drops_are_known(self) -> DemoObjectConfig:
        if self.held_out and not set(self.held_out) < set(self.drops):
            raise ValueError("held_out: expected names of some drops, not of all")
        return self


class DemoPhotographsConfig(Section):
    """The photographs of an object at rest: two rings, and some from where the video cameras stand."""

    rings: tuple[int, ...] = Field((17, 17), description="photographs in each ring")
    elevations: tuple[float, ...] = Field((30.0, 58.0), description="of the rings above the floor [degrees]")
    distances: tuple[float, ...] = Field((1.0, 0.9), description="of the rings from their target [m]")
    beside_cameras: int = Field(2, ge=0, description="more photographs next to each video camera")
    target: Vector = Field(
        (-0.12, 0.08, 0.0), description="centre of the pictures, with random deviations [m]"
    )
    shake: float = Field(0.04, ge=0, description="standard deviation of their places and targets [m]")
    upright: int = Field(4, ge=2, description="every so many, the phone is held upright")
    lens: LensConfig = Field(description="of the phone")
    exposure: float = Field(
        0.15,
        ge=0,
        lt=1,
        description="most by which the light of a photograph differs from the mean, as a share",
    )
    noise: float = Field(1.5, ge=0, description="standard deviation of a pixel's noise [1/255]")
    samples: int = Field(4, ge=1, description="Cycles samples a pixel, denoised")
    quality: int = Field(92, ge=50, le=100, description="of JPEG")

    @model_validator(mode="after")
    def _rings_are_whole(self) -> DemoPhotographsConfig:
        if not len(self.rings) == len(self.elevations) == len(self.distances):
            raise ValueError("rings, elevations and distances: expected as many of each")
        return self

    def count(self, cameras: int) -> int:
        """Photographs, where there are so many video cameras."""
        return sum(self.rings) + self.beside_cameras * cameras


class DemoVideosConfig(Section):
    """The videos of a drop."""

    rate: int = Field(120, gt=0, description="frames a second")
    frames: int = Field(54, ge=8, description="frames of a video")
    exposure: float = Field(
        0.002, ge=0, lt=0.1, description="how long each is exposed [s]; its time is the middle"
    )
    noise: float = Field(2.0, ge=0, description="standard deviation of a pixel's noise [1/255]")
    samples: int = Field(4, ge=1, description="Cycles samples a pixel, denoised")
    plate_samples: int = Field(
        32, ge=1, description="the same of the empty scene behind the body, which is made once"
    )
    quality: int = Field(12, ge=0, le=40, description="constant rate factor of H.264; lower is better")


class DemoTruthConfig(Section):
    """How finely the drops are simulated."""

    grid: int = Field(64, ge=8, description="cells along each side of the unit cube")
    steps: int = Field(24, ge=1, description="time steps from frame to frame of a video")
    particles: int = Field(12_000, gt=0, description="particles of the body")
    tracers: int = Field(5000, gt=0, description="passive tracers that measure the motion")
    gravity: float = Field(9.81, gt=0, description="acceleration [m/s^2]")
    seed: int = Field(3000, ge=0, description="of particles and tracers")


class DemoRoomConfig(Section):
    """The room that is filmed; places as of the cameras."""

    board: BoardConfig = Field(BoardConfig(square=0.042), description="the board, on a page of A3")
    page: Vector = Field(
        (-0.34, 0.0, 0.02), description="middle of the board, which lies with its width along x [m]"
    )
    half: float = Field(2.2, gt=0, description="distance of the walls from the middle [m]")
    wall: float = Field(2.0, gt=0, description="height of the walls [m]")
    texels: int = Field(4096, ge=64, description="pixels of the floor's picture each way")
    lamps: tuple[Vector, ...] = Field(
        ((0.35, 2.4, 0.45), (-0.45, 2.4, -0.25)), description="middle of each round lamp [m]"
    )
    lamp_size: float = Field(0.45, gt=0, description="diameter of the lamps [m]")
    power: float = Field(30.0, gt=0, description="of each lamp [W]")
    ambient: float = Field(0.06, ge=0, description="radiance of the open sky above the walls")
    bounces: int = Field(2, ge=0, description="of light")
    seed: int = Field(11, ge=0, description="of the pictures on floor and walls")


class DemoCapturesConfig(Section):
    """Captures rendered by Blender, to evaluate stages with a known truth ([guide](capture.md#the-demo-captures))."""

    objects: dict[str, DemoObjectConfig] = Field(
        {}, description="objects by name; the capture of each is `demo_<name>`"
    )
    cameras: dict[str, DemoCameraConfig] = Field({}, description="video cameras by name")
    photographs: DemoPhotographsConfig | None = Field(None, description="photographs of each object")
    videos: DemoVideosConfig = Field(DemoVideosConfig(), description="videos of each drop")
    truth: DemoTruthConfig = Field(DemoTruthConfig(), description="simulation of the drops")
    room: DemoRoomConfig = Field(DemoRoomConfig(), description="the room")
    methods: tuple[str, ...] = Field(
        (), description="methods whose predictions are compared with the truth, the untrained prior first"
    )
    resolution: float = Field(1.0, gt=0, le=4, description="factor of the size of all pictures")
    seed: int = Field(0, ge=0, description="of what is held, walked and exposed by hand, and of noise")

    @model_validator(mode="after")
    def _all_or_nothing(self) -> DemoCapturesConfig:
        if self.objects and not (self.cameras and self.photographs):
            raise ValueError("objects: they need cameras and photographs")
        return self
