"""Random scenes of several bodies that touch each other, for a benchmark without manual choices (`random_scenes`)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from neuma_lib.config.base import Vector
from neuma_lib.config.laws import LawConfig
from neuma_lib.project.random_scenes import (
    ATTEMPTS,
    MARGIN,
    MOMENTS,
    SHAPES,
    STEPS,
    RandomConfig,
    appearance,
    contact_and_truth,
    draw_one,
    flight,
    largest_stable,
    rounded,
    unusable,
)

REJECTIONS = {
    "outside": "start outside the box",
    "overlap": "overlap at the start",
    "early": "touch something before the velocity can be seen",
    "late": "touch no other body, or too late",
    "unstable": "need a shorter time step",
}
"""Why a draw is rejected."""
OF_A_BODY = ("shape", "size", "height", "center", "velocity", "spin", "density", "law")
NEAR = 1.0  # distance of two bodies relative to the sum of their radii (`_Fall`) at which they touch


def draw_piles(
    settings: RandomConfig, priors: Mapping[str, LawConfig], grid: int, gravity: Vector
) -> dict[str, dict[str, Any]]:
    """Settings of random scenes of several bodies by name, of different shapes and families.

    Args and errors: as of `random_scenes.draw_scenes`.
    """
    families, scenes = settings.materials, {}
    for k in range(settings.count):
        rng, rejected = np.random.default_rng([settings.seed, 5, k]), Counter[str]()
        low, high = settings.bodies
        count = low + int((high - low + 1) * rng.random())
        shapes, kinds = (
            [items[i] for i in np.argsort(rng.random(len(items)))[:count]]
            for items in (settings.shapes, sorted(families))
        )
        seconds = rounded(settings.duration[0] + (settings.duration[1] - settings.duration[0]) * rng.random())
        bodies: list[dict[str, Any]] = []
        placed: list[_Fall] = []
        for shape, kind in zip(shapes, kinds):
            for _ in range(ATTEMPTS):
                body = draw_one(rng, settings, shape, families[kind])
                fall = _Fall.of(body, seconds, gravity)
                stable = largest_stable(settings, [body["law"]], grid)
                reason = "unstable" if stable is None else _rejection(settings, fall, placed)
                if reason is None:
                    break
                rejected[reason] += 1
            else:
                raise unusable(f"a {shape} next to {len(placed)} bodies", rejected, REJECTIONS)
            bodies.append(body)
            placed.append(fall)
        dt = largest_stable(settings, [body["law"] for body in bodies], grid)
        looks = [appearance(settings, 10 * k + n, *each) for n, each in enumerate(zip(shapes, kinds))]
        own = [
            {key: body[key] for key in OF_A_BODY} | {"appearance": look} for body, look in zip(bodies, looks)
        ]
        least, most = settings.pair_friction
        pairs = [
            {"bodies": list(pair), "friction": rounded(least * (most / least) ** rng.random())}
            for pair in combinations(shapes, 2)
        ]
        scenes[f"{settings.prefix}{k:02d}"] = {
            "bodies": dict(zip(shapes, own)),
            "pairs": pairs,
            "dt": dt,
            "steps": STEPS * max(1, round(seconds / dt / STEPS)),
            **contact_and_truth(settings, k),
        }
    return scenes


def without_first(scenes: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Experiments ``<scene>_rest`` with all bodies but the first, for scenes of several bodies."""
    return {
        f"{name}_rest": {
            "title": f"{name} without the {next(iter(scene['bodies']))}",
            "bodies": [{"scene": f"{name}_{body}"} for body in list(scene["bodies"])[1:]],
            "steps": scene["steps"],
        }
        for name, scene in scenes.items()
        if scene.get("bodies")
    }


class _Fall(NamedTuple):
    """Motion of a body that falls, rotates, and stops where its box reaches the ground."""

    centres: np.ndarray  # of the box [m], shape (T, 3)
    # low, high: ends of a box along the axes that contains the body [m], shape (T, 3)
    low: np.ndarray
    high: np.ndarray
    radius: float  # of a sphere with the volume of the cube of the mean side [m]

    @classmethod
    def of(cls, body: Mapping[str, Any], seconds: float, gravity: Vector) -> "_Fall":
        centres, turned = flight(body, body["size"], gravity, seconds)
        half = np.abs(turned).sum(axis=2)
        below = (centres - half)[:, 1] <= 0
        last = below.argmax() if below.any() else len(centres)
        rows = np.minimum(np.arange(len(centres)), last)
        centres, half = centres[rows], half[rows]
        sides = body["size"] * np.array(SHAPES[body["shape"]].sides)
        return cls(centres, centres - half, centres + half, float(sides.prod() ** (1 / 3)) / 2)


def _rejection(settings: RandomConfig, fall: _Fall, placed: Sequence[_Fall]) -> str | None:
    """Why a body is unusable next to others, one of `REJECTIONS`; None: it is usable.

    It touches others no earlier than their boxes do, and one of them at the latest where their spheres come close.
    """
    if (fall.low[0] < MARGIN).any() or (fall.high[0] > 1 - MARGIN).any():
        return "outside"
    earliest, latest = (round(share * MOMENTS) for share in settings.contact)
    if (fall.low[:earliest] <= 0).any() or (fall.high[:earliest] >= 1).any():
        return "early"
    touches = not placed
    for other in placed:
        gap = np.maximum(fall.low - other.high, other.low - fall.high).max(axis=1)
        if gap[0] < MARGIN:
            return "overlap"
        if (gap[:earliest] <= 0).any():
            return "early"
        near = NEAR * (fall.radius + other.radius)
        touches |= bool((np.linalg.norm(fall.centres - other.centres, axis=1)[:latest] < near).any())
    return None if touches else "late"
