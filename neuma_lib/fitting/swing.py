"""Silhouettes of a body that is held and released: a prediction from mu / rho of the hanging body, and an own fit.

Unknown in addition to those of a body at rest (`neuma_lib.fitting.resting`) are the share of the weight that held the
body, the time of release, and the principal point of the camera that filmed the motion. A still of the held body, with
the marker, shares pose, placement and share. So it determines them almost alone.

The body starts in equilibrium with what holds it, on the mesh of quadratic elements, and moves as particles
(`neuma_lib.coupling.specimens`). The law is elastic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
    RATIO,
    RELEASE,
    UNKNOWNS,
    RestingBody,
    StillFit,
    StillResiduals,
    Stills,
    contours,
    total_cost,
)
from neuma_lib.fitting.resting_records import Progress, resting_body, resting_law
from neuma_lib.io.datasets.stills import Still

Array = NDArray[np.float64]

FRAME = 5e-3
"""Interval of simulated frames [s], between which a cubic spline interpolates."""
FIRST_SHARE = 0.6
"""Share of the weight that is held, before the fit."""
FIRST_RELEASES = (0.0, 0.03, 0.06)
"""Times of release after the first photograph before the fit [s], of which the best is the start."""
_NEIGHBOURS = 40  # particles whose affine motion a point of the surface follows
_DIFFERENCE = 0.02  # of log(mu / rho), and of the share


@dataclass(frozen=True, eq=False)
class Swing:
    """Motions of a body that is released from an equilibrium, of which the last ones are kept.

    Attributes:
        resting: the body before the release, with its region `held`.
        spec: its law as plain values.
        dx: edge of a cell [m].
        duration: simulated time after the release [s].
    """

    resting: RestingBody
    spec: Mapping[str, Any]
    dx: float
    duration: float
    _paths: dict = field(default_factory=dict)

    def path(self, ratio: float, share: float) -> CubicSpline:
        """Function from the time after the release [s] to points of the surface (P, 3) [m] in the body's frame."""
        key = round(ratio, 9), round(share, 9)
        if key not in self._paths:
            if len(self._paths) > 8:
                self._paths.pop(next(iter(self._paths)))
            self._paths[key] = self._simulated(ratio, share)
        return self._paths[key]

    def _simulated(self, ratio: float, share: float) -> CubicSpline:
        body = self.resting
        held = body.body, body.at_rest(ratio, share)
        density, clamp = body.shear_modulus / ratio, body.clamps[0]
        specimen = clamped_body(body.body, clamp, density, body.gravity, self.spec, self.dx, held=held)
        times, x = released(specimen, specimen.law(self.spec), self.duration, FRAME)
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
        ratio, share, release = map(float, shape)
        return self.swing.path(ratio, share)(self._elapsed(release))

    def derivatives(self, shape: Array, free: Sequence[int]) -> Array:
        ratio, share, release = map(float, shape)
        path, elapsed = self.swing.path(ratio, share), self._elapsed(release)
        here = path(elapsed)
        result = np.zeros((3, *here.shape))
        if RATIO in free:
            result[0] = (self.swing.path(ratio * np.exp(_DIFFERENCE), share)(elapsed) - here) / _DIFFERENCE
        if HELD in free:
            result[1] = (self.swing.path(ratio, share + _DIFFERENCE)(elapsed) - here) / _DIFFERENCE
        if 0 < self.time - release < self.swing.duration:
            result[2] = -path(elapsed, 1)
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
    fixed_ratio: bool,
    iterations: int = 12,
) -> SwingFit:
    """Fit everything but mu / rho, or mu / rho as well.

    The still of the held body is fitted first. Time of release and principal point follow from the frames, and then all
    unknowns from all pictures.

    Args:
        held: still of the held body with the marker, by the first camera.
        frames: silhouettes of the motion.
        times: of the frames [s].
        poses, placement, placement_std, ratio, fixed_ratio: as in `fitting.resting.fit_still`.
    """
    body = swing.resting
    alone = [
        Stills([StillResiduals(held, body, pose, placement, placement_std, ratio, FIRST_SHARE)])
        for pose in poses
    ]
    first = [*range(9), HELD]
    starts = [(problem, *problem.minimise(np.zeros(UNKNOWNS), first, 30)) for problem in alone]
    problem, u, _ = min(starts, key=lambda each: total_cost(*each[1:]))
    pose, found, shape, _ = problem.parts[0].values(u)
    fits = []
    for release in FIRST_RELEASES:
        own = ratio, float(shape[1]), release
        parts = [StillResiduals(held, body, pose, placement, placement_std, *own)]
        parts += [
            StillResiduals(
                frame, SwingingBody(swing, time), pose, placement, placement_std, *own, centre=(0.0, 0.0)
            )
            for frame, time in zip(frames, times, strict=True)
        ]
        start = np.zeros(UNKNOWNS)
        start[6:9] = (found - placement) / placement_std
        joint = Stills(parts)
        fits.append((joint, *joint.minimise(start, [RELEASE, *range(UNKNOWNS)[CENTRE]], iterations)))
    joint, u, _ = min(fits, key=lambda each: total_cost(*each[1:]))
    free = [*range(9), HELD, RELEASE, *range(UNKNOWNS)[CENTRE], *([] if fixed_ratio else [RATIO])]
    u, fit = joint.minimise(u, free, iterations, min_gain=1e-3)
    before, *during = joint.results(u, fit, free)
    return SwingFit(before, during, sag(body, before.shape))


def sag(body: RestingBody, shape: Sequence[float]) -> float:
    """Drop of the free end before a release [m]: of the points of the surface that are farthest from the clamp."""
    moved = body.positions(np.array(shape)) - body.undeformed
    low, high = np.array(body.clamps[0].lowest), np.array(body.clamps[0].highest)
    away = np.maximum(low - body.undeformed, body.undeformed - high).max(axis=1)
    end = away > away.max() - 1e-6
    return float((moved[end] @ body.gravity).mean() / np.linalg.norm(body.gravity))


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
    """Predict a swing from the hanging body under each clamp, and fit it, on each grid.

    Args:
        mesh: surface in the unit of the file.
        held, poses: as in `fit_swing`.
        frames: silhouettes by their times [s].
        ratios: mu / rho of the hanging body [m^2/s^2] by clamp.
        size: largest edge of an element before the release [m].
        cells: edges of a cell of the simulation [m].

    Returns:
        Plain values: ``clamps``, name -> ``hang``, mu / rho, and ``grids``, a list of ``cell``, ``predicted`` and
        ``fitted``, see `SwingFit.as_dict`, and ``silhouettes``, those of the prediction on the last grid [px].
    """
    clamps, done, total = {}, 0, 2 * len(ratios) * len(cells)
    duration = max(frames) - min(0.0, *FIRST_RELEASES) + 0.02
    prior = np.array(settings.placement), settings.placement_std
    for name, ratio in ratios.items():
        body, grids = resting_body(mesh, settings, settings.clamps[name], size, swing.held), []
        silhouettes: list[list] = []
        for dx in cells:
            motion = Swing(body, resting_law(settings.nu), dx, duration)
            own: dict[str, Any] = {"cell": dx}
            for key in ("predicted", "fitted"):
                given = key == "predicted"
                fit = fit_swing(
                    held, list(frames.values()), list(frames), motion, poses, *prior, ratio, given
                )
                own[key] = fit.as_dict()
                if given:
                    silhouettes = [
                        [line.round(1).tolist() for line in contours(frame.predicted)] for frame in fit.frames
                    ]
                done += 1
                if progress:
                    progress(done, total)
            grids.append(own)
        clamps[name] = {"hang": ratio, "grids": grids, "silhouettes": silhouettes}
    return {"times": list(frames), "clamps": clamps}
