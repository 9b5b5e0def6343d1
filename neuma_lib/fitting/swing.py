"""Silhouettes of a body that is held and released: a prediction from mu / rho of the hanging body, and own fits.

Unknown in addition to those of a body at rest (`neuma_lib.fitting.resting`) are the share of the weight that held the
body, the time of release, and the principal point of the camera that filmed the motion. A still of the held body, with
the marker, shares pose, placement and share. So it determines them almost alone.

The body starts in equilibrium with what holds it, on the mesh of quadratic elements, and moves as particles
(`neuma_lib.coupling.specimens`). The law is elastic, or a Kelvin-Voigt solid whose retardation time, viscosity / mu, is
fitted. A vibration of angular frequency w then has a damping ratio of w / 2 times that time, and the simulation's own.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from neuma_lib.config.stills import RestingBodyConfig, SwingConfig
from neuma_lib.coupling.interpolation import Interpolation
from neuma_lib.coupling.specimens import clamped_body, released
from neuma_lib.fitting.resting import (
    CENTRE,
    HELD,
    PLACEMENT,
    RATIO,
    RELEASE,
    RETARDATION,
    UNKNOWNS,
    RestingBody,
    StillFit,
    StillResiduals,
    Stills,
    contours,
    total_cost,
)
from neuma_lib.fitting.resting_records import Progress, over_clamps, resting_body, resting_law
from neuma_lib.fitting.vibration import Vibration, fit_vibration
from neuma_lib.io.datasets.stills import Still
from neuma_lib.sim.equilibrium import extrapolated

Array = NDArray[np.float64]

FRAME = 5e-3  # interval of simulated frames [s], between which a cubic spline interpolates
FIRST_SHARE = 0.6  # share of the weight that is held, before the fit
FIRST_RELEASES = (0.0, 0.03, 0.06)
"""Times of release after the first photograph before the fit [s], of which the best is the start."""
FIRST_RETARDATION = 5e-3  # retardation time before it is fitted [s]
FITS = {"predicted": (), "fitted": (RATIO,)}
"""Results of a swing on each grid, and the numbers of the shape that each fits in addition to share and release."""
_NEIGHBOURS = 40  # particles whose affine motion a point of the surface follows
_DIFFERENCES = {RATIO: 0.02, HELD: 0.02, RETARDATION: 0.2}  # of logarithms, and of the share
_VIBRATION = 4.0  # simulated time for the damping, in durations of the swing


@dataclass(frozen=True, eq=False)
class Swing:
    """Motions of a body that is released from an equilibrium, of which the last ones are kept."""

    resting: RestingBody  # the body before the release, with its region `held`
    spec: Mapping[str, Any]  # its elastic law as plain values
    dx: float  # edge of a cell [m]
    duration: float  # simulated time after the release [s]
    _paths: dict = field(default_factory=dict)

    def path(self, ratio: float, share: float, retardation: float = 0.0) -> CubicSpline:
        """Function from the time after the release [s] to points of the surface (P, 3) [m] in the body's frame."""
        key = round(ratio, 9), round(share, 9), round(retardation, 12)
        if key not in self._paths:
            if len(self._paths) > 8:
                self._paths.pop(next(iter(self._paths)))
            self._paths[key] = self._simulated(ratio, share, retardation)
        return self._paths[key]

    def _simulated(self, ratio: float, share: float, retardation: float) -> CubicSpline:
        body, spec = self.resting, dict(self.spec)
        if retardation:
            spec["viscosity"] = {"name": "kelvin_voigt", "viscosity": retardation * body.shear_modulus}
        held = body.body, body.at_rest(ratio, share)
        density, clamp = body.shear_modulus / ratio, body.clamps[0]
        specimen = clamped_body(body.body, clamp, density, body.gravity, spec, self.dx, held=held)
        times, x = released(specimen, specimen.law(spec), self.duration, FRAME)
        points, _ = Interpolation(torch.from_numpy(body.undeformed), specimen.places, _NEIGHBOURS)(x)
        return CubicSpline(times, points.numpy())


@dataclass(frozen=True, eq=False)
class SwingingBody:
    """A `ClampedBody` at a time [s] of the camera's clock."""

    swing: Swing
    time: float

    @property
    def triangles(self) -> NDArray[np.int64]:
        return self.swing.resting.triangles

    @property
    def rotation(self) -> Array:
        return self.swing.resting.rotation

    @property
    def hidden_points(self) -> NDArray[np.bool_]:
        return self.swing.resting.hidden_points

    def _elapsed(self, release: float) -> float:
        return float(np.clip(self.time - release, 0.0, self.swing.duration))

    def positions(self, shape: Array) -> Array:
        ratio, share, release, retardation = map(float, shape)
        return self.swing.path(ratio, share, retardation)(self._elapsed(release))

    def derivatives(self, shape: Array, free: Sequence[int]) -> Array:
        ratio, share, release, retardation = map(float, shape)
        elapsed, h = self._elapsed(release), _DIFFERENCES
        others = {
            RATIO: (ratio * np.exp(h[RATIO]), share, retardation),
            HELD: (ratio, share + h[HELD], retardation),
            RETARDATION: (ratio, share, retardation * np.exp(h[RETARDATION])),
        }
        path = self.swing.path(ratio, share, retardation)
        here = path(elapsed)
        result = np.zeros((len(shape), *here.shape))
        for k, other in others.items():
            if k in free:
                result[k - RATIO] = (self.swing.path(*other)(elapsed) - here) / h[k]
        if 0 < self.time - release < self.swing.duration:
            result[RELEASE - RATIO] = -path(elapsed, 1)
        return result


@dataclass(frozen=True)
class SwingFit:
    """Silhouettes of a swing with one mu / rho.

    Attributes:
        held: agreement with the still of the held body.
        frames: agreement with each silhouette of the motion.
        sag: drop of the free end before the release against the undeformed body [m].
        contour_rms: root mean square of those of the frames [px].
    """

    held: StillFit
    frames: list[StillFit]
    sag: float

    @property
    def contour_rms(self) -> float:
        return float(np.sqrt(np.mean([fit.contour_rms**2 for fit in self.frames])))

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        first = self.frames[0]
        return {
            "ratio": first.ratio,
            "log_std": first.log_std,
            "share": first.shape[1],
            "release": first.shape[2],
            "release_std": first.shape_std[2],
            "retardation": first.shape[3],
            "retardation_log_std": first.shape_std[3],
            "centre": list(first.centre),
            "sag": self.sag,
            "placement": first.placement.tolist(),
            "held_contour_rms": self.held.contour_rms,
            "contour_rms": self.contour_rms,
            "contour_rms_by_frame": [fit.contour_rms for fit in self.frames],
            "iou_by_frame": [fit.iou for fit in self.frames],
            "cost": first.cost,
        }


def fit_swing(
    held: Still,
    frames: Sequence[Still],
    times: Sequence[float],
    swing: Swing,
    poses: Sequence[Array],
    placement: Array,
    placement_std: float,
    ratio: float,
    fitted: Sequence[int] = (),
    before: SwingFit | None = None,
    iterations: int = 12,
) -> SwingFit:
    """Fit pose, placement, share, release and principal point, and those of mu / rho and retardation that are listed.

    The still of the held body is fitted first. Time of release and principal point follow from the frames, and then all
    unknowns from all pictures.

    Args:
        held: still of the held body with the marker, by the first camera.
        frames: silhouettes of the motion.
        times: of the frames [s].
        poses, placement, placement_std, ratio: as in `fitting.resting.fit_still`.
        fitted: of `RATIO` and `RETARDATION`. A body whose retardation has not been fitted is elastic.
        before: another fit of the same pictures, from which this one starts.
    """
    body, prior = swing.resting, (placement, placement_std)
    first = FIRST_RETARDATION * (RETARDATION in fitted)

    def joint(pose: Array, found: Array, shape: Sequence[float], centre: tuple[float, float]):
        """All pictures, and unknowns with a placement."""
        parts = [StillResiduals(held, body, pose, *prior, *shape)]
        for frame, time in zip(frames, times, strict=True):
            parts.append(
                StillResiduals(frame, SwingingBody(swing, time), pose, *prior, *shape, centre=centre)
            )
        u = np.zeros(UNKNOWNS)
        u[PLACEMENT] = (found - placement) / placement_std
        return Stills(parts), u

    if before is None:
        alone = [Stills([StillResiduals(held, body, pose, *prior, ratio, FIRST_SHARE)]) for pose in poses]
        own = [*range(9), HELD]
        fits = [(problem, *problem.minimise(np.zeros(UNKNOWNS), own, 30)) for problem in alone]
        problem, u, _ = min(fits, key=lambda each: total_cost(*each[1:]))
        pose, found, shape, _ = problem.parts[0].values(u)
        starts = [joint(pose, found, (ratio, shape[1], t, first), (0.0, 0.0)) for t in FIRST_RELEASES]
        own = [RELEASE, *range(UNKNOWNS)[CENTRE]]
        fits = [(problem, *problem.minimise(u, own, iterations)) for problem, u in starts]
        problem, u, _ = min(fits, key=lambda each: total_cost(*each[1:]))
    else:
        last = before.frames[0]
        shape = *last.shape[:3], last.shape[3] or first
        problem, u = joint(last.pose, last.placement, shape, last.centre)
    free = [*range(9), HELD, RELEASE, *range(UNKNOWNS)[CENTRE], *fitted]
    u, fit = problem.minimise(u, free, iterations, min_gain=1e-3)
    still, *during = problem.results(u, fit, free)
    return SwingFit(still, during, sag(body, still.shape))


def sag(body: RestingBody, shape: Sequence[float]) -> float:
    """Drop of the free end before a release against the undeformed body [m]."""
    return float(_drop(body, body.positions(np.array(shape))))


def vibration(swing: Swing, shape: Sequence[float]) -> Vibration:
    """That of the free end after the release, with the damping of the simulation."""
    ratio, share, _, retardation = shape
    longer = replace(swing, duration=_VIBRATION * swing.duration, _paths={})
    times = np.arange(0.0, longer.duration, FRAME)
    return fit_vibration(times, _drop(swing.resting, longer.path(ratio, share, retardation)(times)))


def _drop(body: RestingBody, x: Array) -> Array:
    """Mean drop (...) [m] of the points of a surface (..., P, 3) that are farthest from the clamp."""
    low, high = np.array(body.clamps[0].lowest), np.array(body.clamps[0].highest)
    away = np.maximum(low - body.undeformed, body.undeformed - high).max(axis=1)
    end = away > away.max() - 1e-6
    down = body.gravity / np.linalg.norm(body.gravity)
    return ((x - body.undeformed)[..., end, :] @ down).mean(axis=-1)


def swing_record(
    mesh: trimesh.Trimesh,
    settings: RestingBodyConfig,
    swing: SwingConfig,
    held: Still,
    frames: Mapping[float, Still],
    poses: Sequence[Array],
    ratios: Mapping[str, float],
    size: float,
    cells: Sequence[float],
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Predict a swing from the hanging body under each clamp, and fit it without and with a viscosity, on each grid.

    Args:
        mesh: surface in the unit of the file.
        held, poses: as in `fit_swing`.
        frames: silhouettes by their times [s].
        ratios: mu / rho of the hanging body [m^2/s^2] by clamp.
        size: largest edge of an element before the release [m].
        cells: edges of a cell of the simulation [m].

    Returns:
        Plain values: ``clamps``, name -> ``hang``, mu / rho, ``grids``, a list of ``cell`` and the results of `FITS`,
        see `SwingFit.as_dict`, ``damped``, the result with a retardation time on the first grid, with its ``vibration``
        and the same ``without_viscosity``, and ``silhouettes``, those of the prediction on the last grid [px].
        ``ratio``, mu / rho of the elastic body, is extrapolated from the last two grids. Its ``log_std`` combines
        ``noise_std`` and ``grid_std``, the step of the extrapolation, and over all clamps ``clamp_std``.
    """
    clamps, done, total = {}, 0, (len(FITS) * len(cells) + 1) * len(ratios)
    duration = max(frames) - min(0.0, *FIRST_RELEASES) + 0.02
    pictures = held, list(frames.values()), list(frames)
    prior = poses, np.array(settings.placement), settings.placement_std

    def fit(motion: Swing, ratio: float, fitted: Sequence[int], before: SwingFit | None) -> SwingFit:
        nonlocal done
        result = fit_swing(*pictures, motion, *prior, ratio, fitted, before)
        done += 1
        if progress:
            progress(done, total)
        return result

    for name, ratio in ratios.items():
        body = resting_body(mesh, settings, settings.clamps[name], size, swing.held)
        motions = [Swing(body, resting_law(settings.nu), dx, duration) for dx in cells]
        grids: list[dict[str, SwingFit]] = []
        for motion in motions:
            own: dict[str, SwingFit] = {}
            for key, fitted in FITS.items():
                before = grids[-1][key] if grids else own.get("predicted")
                own[key] = fit(motion, ratio, fitted, before)
            grids.append(own)
        damped = fit(motions[0], ratio, (RATIO, RETARDATION), grids[0]["fitted"])
        shape = damped.held.shape
        vibrations = {"vibration": shape, "without_viscosity": (*shape[:3], 0.0)}
        silhouettes = [contours(frame.predicted) for frame in grids[-1]["predicted"].frames]
        results = [
            {"cell": dx, **{key: each.as_dict() for key, each in own.items()}}
            for dx, own in zip(cells, grids, strict=True)
        ]
        clamps[name] = {
            "hang": ratio,
            "grids": results,
            "damped": damped.as_dict()
            | {key: asdict(vibration(motions[0], own)) for key, own in vibrations.items()},
            "silhouettes": [[line.round(1).tolist() for line in lines] for lines in silhouettes],
            **over_grids(results),
        }
    return {"times": list(frames), "clamps": clamps, **over_clamps(clamps)}


def over_grids(grids: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """mu / rho of the elastic body from the last two of ``grids``, see `swing_record`."""
    log, noise = math.log(grids[-1]["fitted"]["ratio"]), grids[-1]["fitted"]["log_std"]
    step = 0.0
    if len(grids) > 1:
        coarse = math.log(grids[-2]["fitted"]["ratio"])
        step = extrapolated(coarse, log, grids[-2]["cell"] / grids[-1]["cell"]) - log
    std = math.hypot(noise, step)
    return {"ratio": math.exp(log + step), "noise_std": noise, "grid_std": abs(step), "log_std": std}
