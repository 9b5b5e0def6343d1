"""Information of an experiment about an identified material, predicted before it is done.

The experiment is simulated and rendered with the identified constants. Its images r(u) have derivatives J with respect
to the unbounded constants and, as in an identification, to the initial motion and the position of the rendered body,
which are known up to standard deviations. The Gauss-Newton information on the constants is (J^T J) / s^2 without the
part that these other unknowns may explain (its Schur complement). It adds to the inverse of the covariance that the
identification reports. The inverse of the sum is the expected covariance after a joint fit.

Residuals of a fit are correlated errors of the reconstruction, so their variance s^2 per unit of curvature cannot be
counted in pixels. It is chosen so that the same computation for the videos that exist has the determinant of the
covariance that their identification reports (`matched_noise`).

A rival family is first fitted to images of the identified law in the existing videos, so that it explains them as well
as it can. In a new experiment it may still change within what these videos admit. Half its remaining squared residual
over s^2 is the expected logarithm of the Bayes factor, without the Occam factors of the constants.

Derivatives are differences as wide as the standard deviations of the constants, on the side where the images change
less. A constant on a plateau of the images, such as a yield stress that is hardly reached, has no information then,
although it has a derivative.

An experiment with large deformations is simulated less accurately than the first one. s^2 increases by the ratio by
which a joint fit lowers the weight of its residuals (`video_residuals.noise_ratio`).

All of this is to first order about the identified constants.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.optimize import brentq
from torch import Tensor

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.family_run import FamilyRun
from neuma_lib.fitting.identified import FamilyFit
from neuma_lib.fitting.least_squares import Linearisation
from neuma_lib.fitting.video_residuals import (
    COARSER,
    NUISANCES,
    Candidate,
    VideoResiduals,
    noise_ratio,
    weigh,
)
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import Values, physical
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.model import MPM
from neuma_lib.sim.state import State
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.observation import Observation

_NOISE_RANGE = 1e12  # largest ratio of the noise to the mean curvature, and its inverse


@dataclass(frozen=True)
class Experiment:
    """A motion of the body that has been filmed, or could be."""

    model: MPM  # simulator constants, with the obstacles and clamps of the experiment
    # initial motion, with the standard deviations that an estimate before contact has or would have
    motion: InitialMotion
    body: Reconstruction  # the body in its initial pose
    video: Sequence[Observation]  # frames and cameras. Images are not used.

    def residuals(self, settings: IdentifyConfig) -> VideoResiduals:
        return VideoResiduals(self.model, self.motion, self.body, self.video, settings)


def unfilmed(frames: Sequence[int], cameras: Cameras) -> Observation:
    """A video that does not exist yet: black images of the frames."""
    shape = (len(frames), len(cameras), cameras.height, cameras.width, 4)
    return Observation(tuple(frames), torch.zeros(shape, dtype=torch.uint8), cameras)


@dataclass(frozen=True)
class Forecast:
    """Expected result of an experiment."""

    fit: FamilyFit  # the identified family with the expected covariance of its unbounded constants
    information: np.ndarray  # that of the experiment alone on the unbounded constants, shape (k, k)
    # expected logarithm of the Bayes factor of the identified family against each rival, by name
    evidence: dict[str, float]


@dataclass
class _Rival:
    """A family that imitates the identified one in the existing videos."""

    family: Family
    values: Values
    information: np.ndarray


@dataclass
class Knowledge:
    """Results of the identification in existing videos, and the forecast of a further experiment."""

    fit: FamilyFit  # the identified family and constants, with the covariance of the unbounded ones
    settings: IdentifyConfig  # those of the identification
    noise: float  # variance s^2 of the residuals of the existing videos per unit of curvature
    difference: float  # `VideoResiduals.coarser_difference` of the first of them
    _rivals: list[_Rival] = field(default_factory=list)

    @classmethod
    def of_videos(
        cls,
        fit: FamilyFit,
        filmed: Sequence[Experiment],
        settings: IdentifyConfig,
        rivals: Sequence[tuple[Family, Values]] = (),
    ) -> "Knowledge":
        """Simulate the existing videos once more, which calibrates the noise, and fit the rivals to them.

        Args:
            fit: as attribute.
            filmed: the experiments in which it was identified.
            rivals: other families with constants to start from.

        Raises:
            InputError: the identification states no covariance.
            NonFiniteError: a simulation with the identified constants diverges.
        """
        if fit.covariance is None or not np.isfinite(fit.covariance).all():
            problem = "states no uncertainty of the constants"
            raise InputError("identified", problem, "Identify the scene again")
        videos = [each.residuals(settings) for each in filmed]
        difference = weigh(videos, _candidate(fit), fit.loss)
        curvature = _linearised(fit, videos, settings).curvature
        noise = matched_noise(curvature, fit.covariance, settings.spread)
        own = cls(fit, settings, noise, difference)
        for family, values in rivals:
            run = FamilyRun(family, videos, [len(video.frames) for video in videos], settings)
            try:
                run.imitate(values, noise)
            except NonFiniteError:  # it cannot explain the existing videos
                continue
            k = len(family.constants)
            gained = information(run.fit.curvature, noise, k) + np.eye(k) / settings.spread**2
            own._rivals.append(_Rival(family, run.values, gained))
        return own

    def forecast(self, experiment: Experiment, of: Experiment | None = None) -> Forecast:
        """Expected result of an experiment.

        Args:
            of: an existing experiment of which this one is another video, with the same unknown motion. The videos of
                ``experiment`` include those of it.

        Raises:
            NonFiniteError: its simulation diverges.
        """
        k = len(self.fit.family.constants)
        video = experiment.residuals(self.settings)
        curvature = self._linearised(video).curvature
        noise = self.noise_in(video)
        gained = information(curvature, noise, k)
        if of is not None:
            gained = gained - information(self._linearised(of.residuals(self.settings)).curvature, noise, k)
        covariance = added(self.fit.covariance, gained)
        evidence = {rival.family.name: self._evidence(rival, video, noise) for rival in self._rivals}
        return Forecast(replace(self.fit, covariance=covariance), gained, evidence)

    def noise_in(self, video: VideoResiduals) -> float:
        """Variance of the residuals per unit of curvature in a video of the identified law.

        It is that of the existing videos times `noise_ratio`.
        """
        difference = video.coarser_difference(_candidate(self.fit), COARSER)
        return self.noise * noise_ratio(difference, self.difference, self.fit.loss)

    def _linearised(self, video: VideoResiduals) -> Linearisation:
        return _linearised(self.fit, [video], self.settings)

    def _evidence(self, rival: _Rival, video: VideoResiduals, noise: float) -> float:
        """Expected logarithm of the Bayes factor in a video of the identified family against a rival.

        The rival changes its constants within the information of the existing videos, and the motion within its
        standard deviations. A rival that diverges predicts nothing, and is excluded by any image.
        """
        run = FamilyRun(rival.family, [video], [len(video.frames)], self.settings)
        try:
            fit = run.linearise_at(rival.values)
        except NonFiniteError:
            return math.inf
        k = len(rival.family.constants)
        H, g = fit.curvature / noise, fit.slope / noise
        H += np.eye(len(H))
        H[:k, :k] += rival.information - np.eye(k)
        return 0.5 * max(fit.cost / noise - g @ np.linalg.solve(H, g), 0.0)


def _candidate(fit: FamilyFit) -> Candidate:
    return Candidate(fit.family.law_spec(fit.values), np.zeros(NUISANCES))


def _linearised(fit: FamilyFit, videos: Sequence[VideoResiduals], settings: IdentifyConfig) -> Linearisation:
    """Replace videos by the images of a fit, and linearise them there, with residuals of 0."""
    for video in videos:
        if not video.observe(_candidate(fit)):
            raise NonFiniteError(fit.family.name, "the simulation with the identified constants diverges")
    run = FamilyRun(fit.family, videos, [len(video.frames) for video in videos], settings)
    return run.linearise_at(fit.values, fit.covariance)


def information(curvature: np.ndarray, noise: float, constants: int) -> np.ndarray:
    """Information (k, k) on the constants, the Schur complement of the other unknowns with the prior 0 +- 1.

    Args:
        curvature: J^T J of all unknowns, the k constants first.
        noise: variance of the residuals per unit of curvature.
        constants: k.
    """
    k, H = constants, curvature / noise
    others = H[k:, k:] + np.eye(len(H) - k)
    return H[:k, :k] - H[:k, k:] @ np.linalg.solve(others, H[k:, :k])


def added(covariance: np.ndarray, *gained: np.ndarray) -> np.ndarray:
    """Covariance (k, k) after experiments whose information adds to the inverse of a covariance."""
    root = np.linalg.cholesky(covariance)
    inner = np.eye(len(root)) + root.T @ sum(gained) @ root
    return root @ np.linalg.solve(inner, root.T)


def matched_noise(curvature: np.ndarray, covariance: np.ndarray, width: float) -> float:
    """The noise with which the information of a fit has the determinant of its reported covariance (k, k).

    Args:
        curvature: J^T J of all unknowns of the fit, the k constants first.
        width: prior standard deviation of the unbounded constants.
    """
    k = len(covariance)
    reported = -np.linalg.slogdet(covariance)[1]

    def excess(log_noise: float) -> float:
        gained = information(curvature, math.exp(log_noise), k) + np.eye(k) / width**2
        return np.linalg.slogdet(gained)[1] - reported

    scale = math.log(max(np.trace(curvature[:k, :k]) / k, 1e-300))
    low, high = scale - math.log(_NOISE_RANGE), scale + math.log(_NOISE_RANGE)
    if excess(high) >= 0 or excess(low) <= 0:  # the fit determines nothing, or all constants exactly
        return math.exp(high if excess(high) >= 0 else low)
    return math.exp(brentq(excess, low, high, xtol=1e-9))


def stds(fit: FamilyFit, settings: IdentifyConfig) -> dict[str, float]:
    """Standard deviations of the logarithms of the constants to determine: G and K in place of E and nu, and others."""
    return {name: std for name, _, std in fit.quantities(settings) if name in physical(fit.values)}


def spread(fit: FamilyFit, settings: IdentifyConfig) -> float:
    """Geometric mean of `stds`."""
    return math.exp(float(np.mean(np.log(list(stds(fit, settings).values())))))


def undetermined(fit: FamilyFit, settings: IdentifyConfig) -> list[str]:
    """Constants of `stds` that are not determined."""
    return [name for name, std in stds(fit, settings).items() if std >= settings.determined]


def newly_determined(
    before: FamilyFit, after: FamilyFit, settings: IdentifyConfig
) -> dict[str, tuple[float, float]]:
    """Quantities and combinations that become determined: standard deviations of the logarithm before and after.

    Named quantities (`FamilyFit.quantities`) come first. If there are none, the combination of physical constants with
    the largest ratio is named by its powers, for example ``G^0.8 K^-0.6``, if it becomes determined.
    """
    old, new = ({name: std for name, _, std in fit.quantities(settings)} for fit in (before, after))
    limit = settings.determined
    named = {key: (std, new[key]) for key, std in old.items() if new[key] < limit <= std}
    if named:
        return named
    names, C = before.log_covariance(physical)
    _, D = after.log_covariance(physical)
    # Generalised eigenvectors: the axis whose variance decreases most.
    root = np.linalg.cholesky(D + 1e-12 * np.eye(len(D)))
    inverse = np.linalg.inv(root)
    _, vectors = np.linalg.eigh(inverse @ C @ inverse.T)
    axis = inverse.T @ vectors[:, -1]
    axis = axis / np.linalg.norm(axis)
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    pair = [math.sqrt(float(axis @ part @ axis) + settings.model_std**2) for part in (C, D)]
    if not pair[1] < limit <= pair[0]:
        return {}
    powers = [f"{key}^{power:.1f}" for key, power in zip(names, axis, strict=True) if abs(power) >= 0.05]
    return {" ".join(powers): (pair[0], pair[1])}


def motion_derivatives(
    fit: FamilyFit, model: MPM, start: State, frames: Sequence[int], settings: IdentifyConfig
) -> Tensor:
    """Derivatives of positions by the unbounded constants, forward differences, shape (k, T, N, 3) [m].

    Raises:
        NonFiniteError: the motion diverges.
    """
    family, u, h = fit.family, fit.family.unbounded(fit.values), settings.difference
    density = float(start.density.min())
    points = [u, *(u - h * e for e in np.eye(len(u)))]  # softer, hence within the limit of the time step
    laws = [analytic_law(family.law_spec(family.values(p, model, density)), model.dt) for p in points]
    laws = [law.to(start.x.device) for law in laws]
    base, *others = rollout_batch(model, laws, start, steps=frames[-1], frames=frames)
    if base is None or any(other is None for other in others):
        raise NonFiniteError("next.predict", "the motion with the identified constants diverges")
    return torch.stack([(base.x - other.x) / h for other in others])


def motion_std(derivatives: Tensor, covariance: np.ndarray) -> float:
    """Root mean square standard deviation of positions [m] with derivatives (k, T, N, 3) and a covariance (k, k)."""
    J = derivatives.double().flatten(1)
    C = torch.from_numpy(covariance).to(J)
    return math.sqrt(3 * float(((C @ J) * J).sum(0).mean()))
