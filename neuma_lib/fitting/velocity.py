"""Initial velocity from the frames before contact (paper Sec. 3.1), through renderer and simulator.

The unknown is one 3-vector, so the image residuals r(v0) are minimised by Levenberg-Marquardt with a numerical
Jacobian instead of a thousand gradient steps. One camera sees motion along its own axis only as a change of size:
that axis is determined far worse than the other two, and a ridge acts on it alone. The paper regularises the same
weakness by a penalty on |v_x| and |v_z|, which would also pull an oblique throw towards the vertical.

What the static Gaussians get wrong is the same in every frame: a body that is rendered one percent too large looks one
percent too near. Taken for motion, that would be half a metre per second in depth. A constant shift of the rendered
body is therefore estimated beside the velocity, and thrown away.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.frame_batches import frame_batches
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPMModel, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.observation import Observation

NUISANCE_SCALE = 0.02
"""Unit of the constant shift [m] and of the relative enlargement: about 1 m/s over a few frames."""
_TILE = 12  # side [px] of the image tiles whose residuals are taken as correlated


@dataclass(frozen=True)
class VelocityEstimate:
    """Result of `estimate_velocity`.

    Attributes:
        v0: initial velocity [m/s], shape (3,).
        std: estimated standard deviation along each world axis [m/s], shape (3,), without the ridge's help.
        axes: rows are the camera's right, down and viewing direction in world axes, shape (3, 3).
        std_camera: standard deviation along those axes [m/s], shape (3,).
        information: curvature of the loss along the camera's axes relative to the best determined one, shape (3,).
        frames: steps of the frames that were used.
        nuisance: what was estimated along: constant shift of the rendered body to the right and down [m], and its
            relative enlargement, shape (3,).
        loss: root mean square image residual at the estimate.
        iterations: accepted Levenberg-Marquardt steps.
        ridge: the ridge that was used (0: none).
    """

    v0: np.ndarray
    std: np.ndarray
    axes: np.ndarray
    std_camera: np.ndarray
    information: np.ndarray
    frames: tuple[int, ...]
    nuisance: np.ndarray
    loss: float
    iterations: int
    ridge: float

    def as_dict(self) -> dict:
        """Plain numbers and lists, for JSON."""
        return {
            "v0": self.v0.tolist(),
            "unit": "m/s",
            "std": self.std.tolist(),
            "camera_axes": self.axes.tolist(),
            "std_camera": self.std_camera.tolist(),
            "information_camera": self.information.tolist(),
            "frames": list(self.frames),
            "nuisance": self.nuisance.tolist(),
            "rms_residual": self.loss,
            "iterations": self.iterations,
            "ridge": self.ridge,
        }

    def summary(self) -> str:
        """One line for people: the estimate, how sure, and what holds the depth axis."""
        v, s, i = self.v0, self.std_camera, self.information
        held = f"ridge {self.ridge:g} on depth" if self.ridge else "no regularisation"
        return (
            f"v0 = ({v[0]:+.3f}, {v[1]:+.3f}, {v[2]:+.3f}) m/s from {len(self.frames)} frames before contact; "
            f"std right {s[0]:.3f}, down {s[1]:.3f}, depth {s[2]:.3f} m/s; "
            f"information {i[0]:.2f}, {i[1]:.2f}, {i[2]:.3f}; {held}"
        )


def estimate_velocity(
    model: MPMModel,
    law: Law,
    body: Reconstruction,
    observation: Observation,
    settings: VelocityConfig,
    progress: Callable[[int, int, float], None] | None = None,
) -> VelocityEstimate:
    """Estimate one velocity for the whole body from the frames before its first contact.

    Args:
        model: simulator constants.
        law: the prior material (before contact it does not matter which).
        body: reconstructed particles and Gaussians.
        observation: the video; frames from contact on are ignored.
        settings: hyper-parameters; its ``views`` are those of the observation.
        progress: called with (step, steps, loss).

    Raises:
        InputError: fewer than two frames, or the body touches a wall in the first frame.
    """
    if len(observation.frames) < 2:
        raise InputError("velocity needs at least two frames of the training view before contact")
    # Double precision is cheap on a CPU. The fast kernels of a GPU are in single, which differences of 0.02 m/s stand.
    precision = torch.float64 if body.x0.device.type == "cpu" else torch.float32
    body, observation = body.to(precision), observation.to(precision)
    law = copy.deepcopy(law).to(precision)
    if float(contact_clearance(model, body.x0)) <= 0:
        raise InputError("the body touches a wall in the first frame: the video must start before contact")
    axes = observation.cameras.viewmats[0, :3, :3].cpu().numpy()
    unknowns = np.zeros(6)  # velocity [m/s], and the nuisance in units of NUISANCE_SCALE
    used = list(range(min(settings.initial_frames, len(observation.frames))))
    accepted = 0
    for _ in range(6):
        seen = observation.select(used)
        residuals = _Residuals(model, law, body, seen, settings.difference)
        unknowns, fit, steps = _levenberg_marquardt(residuals, unknowns, axes, settings, progress)
        accepted += steps
        wider = _frames_before_contact(model, body, observation, unknowns[:3])
        if wider == used or len(wider) < 2:
            break
        used = wider
    std, std_camera, information = _uncertainty(fit, axes)
    return VelocityEstimate(
        v0=unknowns[:3],
        std=std,
        axes=axes,
        std_camera=std_camera,
        information=information,
        frames=seen.frames,
        nuisance=NUISANCE_SCALE * unknowns[3:],
        loss=fit.rms,
        iterations=accepted,
        ridge=settings.ridge,
    )


@dataclass(frozen=True)
class _Linearisation:
    """The least-squares problem around some unknowns: residuals r, Jacobian J, summed up over all pixels.

    Attributes:
        curvature: J^T J, shape (6, 6).
        scores: J^T r of every tile of the image, summed over the frames, shape (tiles, 6).
        cost: r^T r.
        rms: root mean square of r.
    """

    curvature: np.ndarray
    scores: np.ndarray
    cost: float
    rms: float

    @property
    def slope(self) -> np.ndarray:
        """J^T r, shape (6,)."""
        return self.scores.sum(axis=0)


@dataclass
class _Residuals:
    """Rendered minus observed colours as a function of the unknowns. A few frames at a time are in memory."""

    model: MPMModel
    law: Law
    body: Reconstruction
    seen: Observation
    difference: float

    def __post_init__(self):
        self._renderer = self.body.particle_gs(self.seen.cameras)

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squares."""
        return self._checked(
            sum(self._residual(unknowns, part).square().sum().double() for part in self._parts()), unknowns
        )

    def linearise(self, unknowns: np.ndarray) -> _Linearisation:
        """Sums of the residuals and of their central differences."""
        cost, curvature, scores = 0.0, 0.0, 0.0
        for part in self._parts():
            r = self._residual(unknowns, part)
            J = torch.stack(
                [
                    self._render(unknowns + e, part) - self._render(unknowns - e, part)
                    for e in self.difference * np.eye(6)
                ]
            ) / (2 * self.difference)
            cost = cost + r.square().sum().double()
            curvature = curvature + (J.flatten(1) @ J.flatten(1).T).double()
            scores = scores + torch.stack([_tile_sums(column * r) for column in J], dim=1).double()
        cost = self._checked(cost, unknowns)
        rms = float(np.sqrt(cost / (len(self.seen.frames) * r[0].numel())))
        return _Linearisation(curvature.cpu().numpy(), scores.cpu().numpy(), cost, rms)

    def _parts(self):
        return frame_batches(len(self.seen.frames), self._renderer.frames_per_batch)

    def _residual(self, unknowns: np.ndarray, part: slice) -> Tensor:
        return self._render(unknowns, part) - self.seen.colours(part)

    def _render(self, unknowns: np.ndarray, part: slice) -> Tensor:
        body, frames = self.body, self.seen.frames[part]
        v0, nuisance = torch.as_tensor(unknowns).to(body.x0).split(3)
        right, down, enlargement = NUISANCE_SCALE * nuisance
        axes = self.seen.cameras.viewmats[0, :3, :3]
        with torch.no_grad():
            path = rollout(self.model, self.law, body.state(v0), steps=frames[-1], frames=frames)
            centre = path.x.mean(dim=1, keepdim=True)
            x = centre + (1 + enlargement) * (path.x - centre) + right * axes[0] + down * axes[1]
            return self._renderer(x, (1 + enlargement) * path.F)

    def _checked(self, cost: Tensor, unknowns: np.ndarray) -> float:
        value = float(cost)
        if not np.isfinite(value):
            raise NonFiniteError(
                "velocity", f"rendered images are not finite at v0 = {unknowns[:3].tolist()}"
            )
        return value


def _tile_sums(values: Tensor) -> Tensor:
    """Sums of (T, V, H, W, C) over the frames, the channels and the pixels of each tile, shape (V * tiles,)."""
    picture = values.sum(dim=(0, 4))
    sums = torch.nn.functional.avg_pool2d(picture[:, None], _TILE, ceil_mode=True, divisor_override=1)
    return sums.flatten()


def _levenberg_marquardt(
    residuals: _Residuals,
    start: np.ndarray,
    axes: np.ndarray,
    settings: VelocityConfig,
    progress: Callable[[int, int, float], None] | None,
) -> tuple[np.ndarray, _Linearisation, int]:
    """Minimise |r(u)|^2 + ridge * curvature * (depth . v)^2: the unknowns, their surroundings, accepted steps."""

    def penalty(H):
        P = np.zeros((6, 6))
        P[:3, :3] = settings.ridge * np.linalg.eigvalsh(H[:3, :3])[-1] * np.outer(axes[2], axes[2])
        return P

    u, damping, accepted = start, 1e-3, 0
    fit = residuals.linearise(u)
    for iteration in range(settings.iterations):
        H = fit.curvature
        P = penalty(H)
        step = -np.linalg.solve(H + P + damping * np.diag(np.diag(H)), fit.slope + P @ u)
        trial = u + step
        if residuals.cost(trial) + trial @ P @ trial < fit.cost + u @ P @ u:
            u, damping, accepted = trial, max(damping / 5, 1e-9), accepted + 1
            fit = residuals.linearise(u)
        else:
            damping *= 8
        if progress:
            progress(iteration + 1, settings.iterations, fit.rms)
        if np.linalg.norm(step) < 1e-5 or damping > 1e6:
            break
    return u, fit, accepted


def _frames_before_contact(
    model: MPMModel, body: Reconstruction, observation: Observation, v0: np.ndarray
) -> list[int]:
    """Indices of the leading frames in which the body, flying freely with v0, is clear of every wall."""
    clear = []
    g, v = (torch.as_tensor(vector).to(body.x0) for vector in (model.gravity, v0))
    for index, n in enumerate(observation.frames):
        x = body.x0 + n * model.dt * v + g * model.dt**2 * n * (n + 1) / 2
        if float(contact_clearance(model, x)) <= 0:
            break
        clear.append(index)
    return clear


def _uncertainty(fit: _Linearisation, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standard deviations of an unregularised fit whose residuals are correlated inside tiles of the image.

    Residuals come from what the static reconstruction cannot show, not from independent pixel noise: scores are
    summed over each tile in all frames before their outer products are added (the cluster-robust covariance
    H^-1 (sum_c g_c g_c^T) H^-1). The curvature that is left for the velocity when the nuisance is free is the Schur
    complement of H.
    """
    inverse = np.linalg.pinv(fit.curvature)
    covariance = (inverse @ (fit.scores.T @ fit.scores) @ inverse)[:3, :3]
    in_camera = axes @ covariance @ axes.T
    curvature = 1 / np.diag(axes @ inverse[:3, :3] @ axes.T)
    return (
        np.sqrt(np.diag(covariance)),
        np.sqrt(np.diag(in_camera)),
        curvature / curvature.max(),
    )
