"""Constants of a law from tracks of markers on a clamped beam that is released.

Least squares over all records at once. Unknown are the constants, as unbounded numbers of `Family`, the place of the
beam in the axes of the records along and up, with priors, and the time of release of each record. A law with a viscous
part separates stiffness at rest, which the sag shows, from that in motion and from damping.

The simulation damps as well. `numerical_damping` measures it with the same law without its viscous part.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from neuma_lib.config.specimens import SpecimenConfig
from neuma_lib.coupling.interpolation import Interpolation
from neuma_lib.coupling.markers import MarkerTracks
from neuma_lib.coupling.specimens import Beam, Specimen, clamped_beam, released
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.vibration import Vibration, fit_vibration
from neuma_lib.mechanics.combinations import Values
from neuma_lib.mechanics.law import Law

FRAME = 2.5e-3  # interval of simulated frames [s], between which a cubic spline interpolates
_END = 0.6  # share of the length beyond which markers are
_NEIGHBOURS = 200  # particles whose affine motion a marker follows
_DIFFERENCE = 0.03  # of unbounded constants
_STEPS = {"place": 1e-4, "release": 5e-4}  # differences [m], [s]
_PRIORS = 2  # last residuals
_EARLY = 0.02  # frames before the release that are compared [s]


@dataclass(frozen=True)
class Record:
    """A released beam that was recorded."""

    name: str  # for results
    tracks: MarkerTracks  # in axes along the beam, up and sideways, from before the release on
    load: float = 0.0  # mass at its free end [kg]


@dataclass(frozen=True)
class Place:
    """Where the beam is in the axes of the records, and how well that is known, as (value, standard deviation) [m]."""

    root: tuple[float, float]  # coordinate along, of the end of the clamp
    axis: tuple[float, float]  # height of the axis of the beam at the clamp


@dataclass(frozen=True)
class RecordFit:
    """Agreement of a record.

    Attributes:
        name: of the record.
        release: time [s].
        rms, largest: distance of markers and prediction [m], over frames and markers.
        measured, predicted: vibration of the mean height of the markers from the first period on.
        times, observed, simulated: heights of the markers, shape (T, M) [m].
    """

    name: str
    release: float
    rms: float
    largest: float
    measured: Vibration
    predicted: Vibration
    times: np.ndarray
    observed: np.ndarray
    simulated: np.ndarray


@dataclass(frozen=True)
class SpecimenFit:
    """Result of `fit_specimen`."""

    family: Family  # of the law
    values: Values  # its constants
    # standard deviations of the logarithms of its constants, for residuals of equal size that are independent
    # between records only. They do not include errors of the grid and of the clamp.
    log_std: dict[str, float]
    # root, axis: see `Place` [m]
    root: float
    axis: float
    records: list[RecordFit]  # agreement of the records
    cost: float  # sum of squared residuals in units of ``noise``
    evaluations: int  # number of simulated beams

    def as_dict(self) -> dict[str, Any]:
        """Constants, place and agreement, for JSON."""
        records = [
            {
                "name": record.name,
                "release": record.release,
                "rms": record.rms,
                "largest": record.largest,
                "measured": asdict(record.measured),
                "predicted": asdict(record.predicted),
            }
            for record in self.records
        ]
        return {
            "law": self.family.law_spec(self.values),
            "log_std": self.log_std,
            "root": self.root,
            "axis": self.axis,
            "records": records,
            "simulated_beams": self.evaluations,
        }


def specimen_problem(
    settings: SpecimenConfig, tracks: Sequence[MarkerTracks], names: Sequence[str]
) -> tuple[Beam, Family, list[Record], Place]:
    """Arguments of `fit_specimen` from settings and the tracks of their records, in the axes of the files."""
    beam = Beam(*settings.size, settings.density)
    records = [
        Record(name, own.turned(settings.along, settings.up), record.load)
        for name, own, record in zip(names, tracks, settings.records, strict=True)
    ]
    return beam, Family("specimen", settings.law.plain()), records, Place(settings.root, settings.axis)


def fit_specimen(
    beam: Beam,
    family: Family,
    records: Sequence[Record],
    place: Place,
    *,
    fitted: Sequence[str],
    cells: int = 4,
    duration: float = 1.0,
    noise: float = 3e-4,
    iterations: int = 12,
    log: Callable[[str], None] = lambda text: None,
) -> SpecimenFit:
    """Fit the constants of a family to records of one beam.

    Args:
        beam: without load.
        family: with guesses of its constants.
        records: with the same markers. Those of equal loads share a simulation.
        place: with priors.
        fitted: names of the fitted constants. The others keep their guesses.
        cells: cells along the height of the beam.
        duration: compared time after the release [s].
        noise: standard deviation of a coordinate of a marker [m], which weighs the priors.
        iterations: maximum number of Jacobians.
    """
    motion = _Motion(beam, family, cells, duration, {record.load for record in records})
    guess = family.unbounded(family.guess)
    free = [family.constants.index(name) for name in fitted]
    releases = [record.tracks.release() for record in records]
    windows = [
        record.tracks.within(release - _EARLY, release + duration)
        for record, release in zip(records, releases, strict=True)
    ]
    still = [record.tracks.before(release) for record, release in zip(records, releases, strict=True)]

    def constants(p: np.ndarray) -> tuple[float, ...]:
        u = guess.copy()
        u[free] += p[: len(free)]
        return tuple(u)

    def predicted(p: np.ndarray) -> list[np.ndarray]:
        root, axis, *later = p[len(free) :]
        u = constants(p)
        result = []
        for k, (record, window, markers) in enumerate(zip(records, windows, still, strict=True)):
            origin = np.array([root, axis, markers[:, 2].min() / 2 + markers[:, 2].max() / 2])
            path = motion.markers(u, record.load, markers - origin)
            elapsed = np.clip(window.times - releases[k] - later[k], 0.0, duration)
            result.append(origin + path(elapsed))
        return result

    def residuals(p: np.ndarray) -> np.ndarray:
        distances = [
            (own - window.positions).ravel() / noise
            for own, window in zip(predicted(p), windows, strict=True)
        ]
        root, axis = p[len(free) : len(free) + 2]
        priors = [(root - place.root[0]) / place.root[1], (axis - place.axis[0]) / place.axis[1]]
        return np.concatenate([*distances, priors])

    start = np.concatenate([np.zeros(len(free)), [place.root[0], place.axis[0]], np.zeros(len(records))])
    steps = np.array([_DIFFERENCE] * len(free) + [_STEPS["place"]] * 2 + [_STEPS["release"]] * len(records))

    def jacobian(p: np.ndarray) -> np.ndarray:
        here = residuals(p)
        # Those that need no other simulation come first, while that of p is kept.
        columns: dict[int, np.ndarray] = {}
        for k in reversed(range(len(p))):
            columns[k] = (residuals(p + steps[k] * np.eye(len(p))[k]) - here) / steps[k]
        values = family.bounded(np.array(constants(p)))
        log(
            f"cost {float(here @ here):.4g}, "
            + ", ".join(f"{name} {values[name]:.4g}" for name in fitted)
            + f", root {1e3 * p[len(free)]:.1f} mm, axis {1e3 * p[len(free) + 1]:.1f} mm"
        )
        return np.stack([columns[k] for k in range(len(p))], axis=1)

    scale = np.array([0.3] * len(free) + [2e-3] * 2 + [5e-3] * len(records))
    fit = least_squares(
        residuals, start, jacobian, x_scale=scale, ftol=1e-3, xtol=1e-3, max_nfev=iterations, loss="linear"
    )
    p, J = fit.x, fit.jac
    # Residuals of a record are errors of the model, which all of its frames share. Priors are not of records.
    share = max(2 * fit.cost / len(records), 1.0)
    data, priors = J[:-_PRIORS], J[-_PRIORS:]
    covariance = np.linalg.pinv(data.T @ data / share + priors.T @ priors)
    deviations = np.sqrt(np.diag(covariance))
    u = np.array(constants(p))
    values = family.bounded(u)
    log_std = {}
    for name, index, deviation in zip(fitted, free, deviations, strict=False):
        shifted = u.copy()
        shifted[index] += 1e-4
        log_std[name] = float(deviation * math.log(family.bounded(shifted)[name] / values[name]) / 1e-4)
    agreements = [
        _agreement(record.name, release + later, window, own)
        for record, release, later, window, own in zip(
            records, releases, p[len(free) + 2 :], windows, predicted(p), strict=True
        )
    ]
    root, axis = p[len(free) : len(free) + 2]
    return SpecimenFit(
        family, values, log_std, float(root), float(axis), agreements, 2 * fit.cost, motion.evaluations
    )


def numerical_damping(beam: Beam, spec: Mapping[str, Any], cells: int, duration: float = 1.0) -> Vibration:
    """Vibration of the height of the free end of a released beam without the viscous part of its law.

    Its damping is that of the simulation.

    Args:
        spec: law with constants of the world. Its viscous part sets the time step.
    """
    specimen = clamped_beam(beam, spec, cells)
    law = specimen.law(spec)
    elastic = Law(law.elasticity, law.plasticity, law.name)
    end = np.array([[beam.length, 0.0, 0.0]])
    times = np.arange(0.0, duration, FRAME)
    path = _simulated(specimen, elastic, duration)
    heights = path(end)(times)[:, 0, 1]
    return fit_vibration(times, heights)


class _Motion:
    """Motions of markers of the released beam for constants and loads, of which the last ones are kept."""

    def __init__(self, beam: Beam, family: Family, cells: int, duration: float, loads: set[float]):
        self._beam, self._family, self._duration = beam, family, duration
        self._cells, self.evaluations = cells, 0
        self._path = lru_cache(maxsize=2 * len(loads))(self._simulated)

    def markers(
        self, u: tuple[float, ...], load: float, places: np.ndarray
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Function from times after the release [s] to positions (T, M, 3) of markers that start at (M, 3) [m]."""
        return self._path(u, load)(places)

    def _simulated(self, u: tuple[float, ...], load: float):
        self.evaluations += 1
        spec = self._family.law_spec(self._family.bounded(np.array(u)))
        specimen = clamped_beam(replace(self._beam, load=load), spec, self._cells)
        return _simulated(specimen, specimen.law(spec), self._duration)


def _simulated(specimen: Specimen, law: Law, duration: float):
    """The motion of markers at places (M, 3) of the beam [m], as a function of places and then of times."""
    times, x = released(specimen, law, duration, FRAME)
    outer = specimen.places[:, 0] > _END * specimen.places[:, 0].max()
    x, anchors = x[:, outer], specimen.places[outer]

    def of_markers(places: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        moved, _ = Interpolation(torch.from_numpy(places), anchors, _NEIGHBOURS)(x)
        return CubicSpline(times, moved.numpy())

    return of_markers


def _agreement(name: str, release: float, window: MarkerTracks, predicted: np.ndarray) -> RecordFit:
    """Distances and vibrations of a record."""
    distance = np.linalg.norm(predicted - window.positions, axis=2)
    later = window.times >= release
    heights = [values[:, :, 1] for values in (window.positions, predicted)]
    vibrations = [fit_vibration(window.times[later], own[later].mean(1)) for own in heights]
    return RecordFit(
        name,
        float(release),
        float(np.sqrt((distance**2).mean())),
        float(distance.max()),
        *vibrations,
        window.times - release,
        *heights,
    )
