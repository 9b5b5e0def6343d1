"""Random scenes: bodies, motions and materials for a benchmark without manual choices.

Scene k depends on the seed, on k, and on the arguments of `draw_scenes`, but not on the number of scenes. Only
`numpy.random.Generator.random` is used, whose stream is stable, and numbers are rounded to three digits, so that all
machines have the same scenes.
"""

import colorsys
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, PositiveFloat, model_validator

from neuma_lib.config.base import Section, Seed, Vector, internal, no_boolean
from neuma_lib.config.dataset import CONVERGED
from neuma_lib.config.laws import LawConfig
from neuma_lib.errors import InputError
from neuma_lib.mechanics.catalogue import stiffest, viscous_stiffness

Item = TypeVar("Item")


class Proportions(NamedTuple):
    """Proportions of a shape. A test compares them with `geometry.shapes`, which settings do not import."""

    size: float  # longest side where a scene does not give it [m]
    sides: Vector  # of the bounding box, the longest is 1
    mass_centre: Vector  # centre of mass relative to the centre of the box, in the same unit
    parts: tuple[str, ...]  # parts with a colour


SHAPES = {
    "ball": Proportions(0.26, (1, 1, 1), (0, 0, 0), ("body", "second", "third", "caps")),
    "duck": Proportions(0.41, (1, 0.9329, 0.7156), (-0.003, -0.076, 0.037), ("body", "wing", "beak", "eye")),
    "pawn": Proportions(0.417, (0.6235, 1, 0.6235), (0, -0.123, 0), ("body", "foot", "collar")),
    "cat": Proportions(
        0.376,
        (0.8716, 1, 0.6639),
        (-0.06, -0.112, 0.018),
        ("body", "thighs", "tail", "stripes", "white", "inner_ear", "eyes", "nose"),
    ),
    "bottle": Proportions(0.438, (0.5205, 1, 0.5205), (0, -0.11, 0), ("body", "cap", "label", "emblem")),
    "fish": Proportions(
        0.402,
        (1, 0.664, 0.5764),
        (0.032, -0.007, 0),
        ("body", "fins", "side_fins", "stripes", "eye", "pupil", "mouth"),
    ),
}
LETTER = Proportions(0.3, (0.25, 0.7, 0.2), (0, 0, 0), ("body",))
"""Size and sides that every letter has at least."""
REJECTIONS = {
    "outside": "start outside the box",
    "early": "touch the ground before the velocity can be seen",
    "late": "touch the ground too late or never",
    "wall": "touch another wall before the ground",
    "unstable": "need a smaller time step",
}
"""Why a draw is rejected."""

ATTEMPTS = 1000
MARGIN = 0.02  # minimum distance of the bounding box from the walls at the start [m]
STEPS = 32  # the steps of a video are a multiple of this, so that its frames are evenly spaced
MOMENTS = 200  # times of a video at which contact is tested
DENSITY = 1000.0  # [kg/m^3]


def _ascending(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError("give the smaller bound first")
    return pair


Range = Annotated[tuple[float, float], AfterValidator(_ascending)]
PositiveRange = Annotated[
    tuple[PositiveFloat, PositiveFloat], BeforeValidator(no_boolean), AfterValidator(_ascending)
]


class DrawnPart(Section):
    """One of the parts of a law: its name, and ranges of its constants by name, sampled log-uniformly."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, PositiveRange]

    name: str = Field(description="name of the elastic law, the return map or the viscous part")

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Minimum and maximum of each constant."""
        return self.__pydantic_extra__ or {}

    def at(self, end: int) -> dict[str, Any]:
        """The part at the minimum (0) or maximum (1) of all constants."""
        return {"name": self.name, **{key: bounds[end] for key, bounds in self.ranges.items()}}


class FamilyConfig(Section):
    """A family of materials."""

    prior: str = Field(description="prior of its scenes, a name in priors.laws")
    look: Literal["solid", "grains", "liquid"] = Field("solid", description="appearance in Blender")
    elasticity: DrawnPart = Field(
        description="elastic law, and minimum and maximum of each constant, for example E: [3e4, 3e5]"
    )
    plasticity: DrawnPart = Field(DrawnPart(name="identity"), description="the same of the return map")
    viscosity: DrawnPart | None = Field(None, description="the same of the viscous part; null: none")
    field: DrawnPart | None = Field(
        None, description="the same of a stiffness that changes along x; null: none"
    )

    @property
    def parts(self) -> dict[str, DrawnPart]:
        """Given parts of the law, in the order in which they are drawn."""
        names = ("elasticity", "plasticity", "viscosity", "field")
        return {key: part for key in names if (part := getattr(self, key))}

    @model_validator(mode="after")
    def _has_a_wave_speed(self) -> Self:
        ranges = self.elasticity.ranges
        if not {"E", "nu"} <= set(ranges) or ranges["nu"][1] >= 0.5:
            raise ValueError("elasticity: give ranges of E and nu, and nu below 0.5")
        return self


class RandomConfig(Section):
    """Random scenes, with names such as random7_03_duck_von_mises."""

    count: int = Field(0, ge=0, le=500, description="number of scenes; a larger number keeps the first ones")
    seed: Seed = Field(0, description="seed of the scenes")
    methods: tuple[str, ...] = Field(
        ("nclaw", "neuma", "constants", "neuma_structured", "true_law"),
        min_length=2,
        description="rows of results/random.csv: the prior, the evaluated method, others",
    )
    families: dict[str, FamilyConfig] = Field(
        {}, description="materials by name, which consecutive scenes take in turn"
    )
    outside: dict[str, FamilyConfig] = Field(
        {}, description="materials by name outside `families`, see draw_from"
    )
    draw_from: Literal["families", "outside", "both"] = Field(
        "families", description="source of the materials"
    )
    shapes: tuple[Literal[tuple(SHAPES)], ...] = internal(
        tuple(SHAPES), "shapes, which consecutive scenes take in turn", min_length=1
    )
    bodies: tuple[int, int] | None = internal(
        None, "minimum and maximum number of bodies of a scene, which touch each other; null: one body"
    )
    pair_friction: PositiveRange = internal(
        (0.1, 0.8), "minimum and maximum of the Coulomb coefficient of two bodies"
    )
    converged: float = internal(
        0.0, "share of the scenes with a converged truth; the others have that of `dataset`", ge=0, le=1
    )
    # Sampled log-uniformly.
    friction: PositiveRange | None = internal(
        None,
        "minimum and maximum of the Coulomb coefficient of the faces of the cube; null: simulation.boundary",
    )
    # No other table may contain scenes of a seed for development, and results/random.csv of it has no verdicts.
    development_seeds: tuple[Seed, ...] = internal(
        (1, 2, 3, 4), "seeds on whose scenes methods are developed"
    )
    reported_seeds: tuple[Seed, ...] = internal(
        (7, 11, 12, 13, 14, 31, 32, 41, 42), "seeds of recorded results, which are used up"
    )
    size: PositiveRange = internal((0.24, 0.4), "longest side of the bounding box [m]")
    height: Range = internal((0.2, 0.7), "initial y of the centre of the bounding box [m]")
    center: Range = internal((0.35, 0.65), "x and z of that centre [m]")
    velocity: tuple[Range, Range, Range] = internal(
        ((-0.8, 0.8), (-1.8, -0.4), (-0.8, 0.8)), "initial velocity along x, y and z [m/s]"
    )
    spin: Range = internal((1.0, 5.0), "initial angular speed about a random axis [rad/s]")
    duration: PositiveRange = internal((0.26, 0.34), "duration of the video [s]")
    contact: Range = internal((0.2, 0.5), "time of the first contact as a fraction of the video")
    dt: tuple[PositiveFloat, ...] = internal(
        (1e-3, 1 / 1500, 5e-4, 1 / 3000),
        "time steps, of which the largest stable one is used [s]",
        min_length=1,
    )
    courant: float = internal(
        0.6,
        "maximum Courant number of true law and prior; training may stiffen a law up to 0.8",
        gt=0,
        le=0.8,
    )

    @model_validator(mode="after")
    def _has_seeds_of_one_kind(self) -> Self:
        if both := sorted({*self.development_seeds} & {*self.reported_seeds}):
            raise ValueError(f"development_seeds: {both[0]} is also one of reported_seeds")
        return self

    @property
    def is_development(self) -> bool:
        """Whether methods are developed on the scenes of the seed."""
        return self.seed in self.development_seeds

    @property
    def prefix(self) -> str:
        """Prefix of the names of the scenes."""
        return f"random{self.seed}_"

    @property
    def materials(self) -> dict[str, FamilyConfig]:
        """Families of the scenes."""
        return {
            **(self.families if self.draw_from != "outside" else {}),
            **(self.outside if self.draw_from != "families" else {}),
        }

    def family(self, name: str) -> str:
        """The family of a scene, from its name."""
        return name.removeprefix(self.prefix).split("_", 2)[2]


def draw_scenes(
    settings: RandomConfig, priors: Mapping[str, LawConfig], grid: int, gravity: Vector
) -> dict[str, dict[str, Any]]:
    """Settings of random scenes by name.

    Args:
        settings: number, families and ranges.
        priors: laws of the priors by name.
        grid: cells along each side of the reconstruction's grid.
        gravity: acceleration [m/s^2].

    Raises:
        InputError: there are no families, or all draws of a scene are unusable.
    """
    families = settings.materials
    if settings.count and not families:
        where = "families" if settings.draw_from == "both" else settings.draw_from
        raise InputError(f"random.{where}", "no families", "Give at least one family of materials")
    scenes = {}
    for k in range(settings.count):
        family = _dealt(sorted(families), settings.seed, 0, k)
        shape = _dealt(settings.shapes, settings.seed, 1, k)
        laws = [law.plain() for name, law in priors.items() if name == families[family].prior]
        rng = np.random.default_rng([settings.seed, 2, k])
        rejected: Counter[str] = Counter()
        for _ in range(ATTEMPTS):
            scene = draw_one(rng, settings, shape, families[family])
            dt = largest_stable(settings, [scene["law"], *laws], grid)
            reason = "unstable" if dt is None else _rejection(settings, scene, gravity)
            if reason is None:
                break
            rejected[reason] += 1
        else:
            raise unusable(f"a {shape} of the family {family}", rejected, REJECTIONS)
        scene |= {"dt": dt, "steps": STEPS * max(1, round(scene.pop("duration") / dt / STEPS))}
        scene |= contact_and_truth(settings, k)
        scene["appearance"] = appearance(settings, k, shape, family)
        scenes[f"{settings.prefix}{k:02d}_{shape}_{family}"] = scene
    return scenes


def unusable(what: str, rejected: Counter[str], reasons: Mapping[str, str]) -> InputError:
    """The error that all draws are unusable, with the number of draws for each of the reasons."""
    counts = ", ".join(f"{number} {reasons[reason]}" for reason, number in rejected.most_common())
    return InputError("random", f"{ATTEMPTS} draws of {what} are unusable: {counts}", "Change the ranges")


def _dealt(items: Sequence[Item], seed: int, deck: int, k: int) -> Item:
    """The k-th item, if all items in random order are used up before the next round."""
    number, place = divmod(k, len(items))
    return items[np.argsort(np.random.default_rng([seed, deck, number]).random(len(items)))[place]]


def draw_one(
    rng: np.random.Generator, settings: RandomConfig, shape: str, family: FamilyConfig
) -> dict[str, Any]:
    """A random scene without time step and appearance, usable or not."""

    def uniform(bounds: tuple[float, float]) -> float:
        return rounded(bounds[0] + (bounds[1] - bounds[0]) * rng.random())

    def part(drawn: DrawnPart) -> dict[str, Any]:
        ranges = sorted(drawn.ranges.items())
        constants = {key: rounded(low * (high / low) ** rng.random()) for key, (low, high) in ranges}
        return {"name": drawn.name, **constants}

    return {
        "shape": shape,
        "size": uniform(settings.size),
        "height": uniform(settings.height),
        "center": [uniform(settings.center), uniform(settings.center)],
        "velocity": [uniform(bounds) for bounds in settings.velocity],
        "spin": [rounded(uniform(settings.spin) * n) for n in _direction(rng)],
        "duration": uniform(settings.duration),
        "law": {key: part(drawn) for key, drawn in family.parts.items()},
        "density": DENSITY,
        "prior": family.prior,
        "story": f"drawn at random with seed {settings.seed}",
    }


def contact_and_truth(settings: RandomConfig, k: int) -> dict[str, Any]:
    """Friction of a scene and resolution of its truth, if they are not those of all scenes.

    Converged truths are evenly distributed: of the first n scenes, round(n * share) have one.
    """
    chosen: dict[str, Any] = {}
    if round((k + 1) * settings.converged) > round(k * settings.converged):
        chosen["truth"] = CONVERGED
    if settings.friction:
        low, high = settings.friction
        draw = np.random.default_rng([settings.seed, 4, k]).random()
        chosen["friction"] = rounded(low * (high / low) ** draw)
    return chosen


def _direction(rng: np.random.Generator) -> list[float]:
    """A uniformly distributed unit vector (Archimedes: its height is uniform)."""
    up, turn = 2 * rng.random() - 1, 2 * math.pi * rng.random()
    flat = math.sqrt(1 - up**2)
    return [flat * math.cos(turn), up, flat * math.sin(turn)]


def rounded(value: float) -> float:
    """Three significant digits, without the last bits in which machines differ."""
    return float(f"{value:.3g}")


def largest_stable(settings: RandomConfig, laws: Sequence[Mapping], grid: int) -> float | None:
    """The largest time step [s] that is stable for all laws, by the speed of pressure waves at small strains."""

    def courant(dt: float) -> float:
        moduli = [  # including fibres and viscous parts
            stiffest(field)
            * (
                part["E"] * (1 - part["nu"]) / ((1 + part["nu"]) * (1 - 2 * part["nu"]))
                + part.get("fibre_modulus", 0.0)
                + (viscous_stiffness({**viscosity, "dt": dt}) if viscosity else 0.0)
            )
            for part, viscosity, field in (
                (law["elasticity"], law.get("viscosity"), law.get("field")) for law in laws
            )
            if {"E", "nu"} <= set(part)
        ]
        return math.sqrt(max(moduli) / DENSITY) * dt * grid

    return max((dt for dt in settings.dt if courant(dt) <= settings.courant), default=None)


def _rejection(settings: RandomConfig, scene: Mapping[str, Any], gravity: Vector) -> str | None:
    """Why a scene is unusable, one of `REJECTIONS`; None: it is usable.

    Before contact the body falls and rotates. It is inside its bounding box and about fills the ellipsoid in that box,
    so it touches the ground no earlier than the rotating box, and not much later than the ellipsoid.

    Walls are at 0 and 1, so that scenes do not depend on the grid. Contact of nodes begins half a cell earlier
    (`MPM.contact`; 0.021 m on 24 cells). A test moves the meshes of many scenes and confirms that no body touches a
    wall at the start, or another wall before the ground, and that at least five frames precede contact.
    """
    proportions = SHAPES[scene["shape"]]
    half = scene["size"] * np.array(proportions.sides) / 2
    middle = np.array([scene["center"][0], scene["height"], scene["center"][1]])
    if (middle - half < MARGIN).any() or (middle + half > 1 - MARGIN).any():
        return "outside"
    middle, turned = flight(scene, scene["size"], gravity, scene["duration"])
    box, ellipsoid = np.abs(turned).sum(axis=2), np.linalg.norm(turned, axis=2)
    earliest, latest = settings.contact
    if _first((middle - box)[:, 1] <= 0) < earliest * MOMENTS:
        return "early"
    landing = _first((middle - ellipsoid)[:, 1] <= 0)
    if landing > latest * MOMENTS:
        return "late"
    touched = np.concatenate([(middle - box)[:, ::2] <= 0, middle + box >= 1], axis=1)
    return "wall" if _first(touched.any(axis=1)) <= landing else None


def flight(
    scene: Mapping[str, Any], size: float, gravity: Vector, duration: float
) -> tuple[np.ndarray, np.ndarray]:
    """Motion of the bounding box of one of `SHAPES` before contact, at `MOMENTS` + 1 times from 0 to the duration [s].

    Args:
        size: longest side of the box [m].

    Returns:
        positions of its centre (T, 3) [m], and its three half axes as columns (T, 3, 3) [m].
    """
    proportions = SHAPES[scene["shape"]]
    R = rotation_matrix(scene.get("rotation", (0.0, 0.0, 0.0)))
    half, offset = size * np.array(proportions.sides) / 2, R @ (size * np.array(proportions.mass_centre))
    middle = np.array([scene["center"][0], scene["height"], scene["center"][1]])
    t = np.linspace(0, duration, MOMENTS + 1)[:, None]
    turned = _rotations(np.array(scene["spin"]), t[:, 0])
    path = middle + offset + t * np.array(scene["velocity"]) + t**2 / 2 * np.array(gravity)
    return path - turned @ offset, turned @ R * half


def rotation_matrix(vector: Sequence[float]) -> np.ndarray:
    """Rotation (3, 3) of a rotation vector [rad]."""
    return _rotations(np.array(vector), np.ones(1))[0]


def _rotations(spin: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Rotations after the times t (T,) [s] of an angular velocity [rad/s], shape (T, 3, 3) (Rodrigues)."""
    speed = float(np.linalg.norm(spin))
    if speed == 0:
        return np.broadcast_to(np.eye(3), (len(t), 3, 3))
    x, y, z = spin / speed
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = speed * t[:, None, None]
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)


def _first(true: np.ndarray) -> float:
    """Index of the first true value; infinity if there is none."""
    return int(true.argmax()) if true.any() else math.inf


def appearance(settings: RandomConfig, k: int, shape: str, family: str) -> dict[str, Any]:
    """Different colours of the parts, and patches that make the motion visible."""
    rng = np.random.default_rng([settings.seed, 3, k])

    def colour() -> str:
        hue, saturation, value = rng.random(), 0.35 + 0.45 * rng.random(), 0.45 + 0.5 * rng.random()
        return "#" + "".join(f"{round(255 * c):02x}" for c in colorsys.hsv_to_rgb(hue, saturation, value))

    return {
        "kind": settings.materials[family].look,
        "colors": {part: colour() for part in SHAPES[shape].parts},
        "accent": colour(),
        "contrast": rounded(0.35 + 0.25 * rng.random()),
        "seed": k,
    }
