"""Initial velocity from the frames before contact (paper Sec. 3.1), through renderer and simulator.

The unknown is one 3-vector, so the image residuals r(v0) are minimised by Levenberg-Marquardt with a numerical
Jacobian instead of a thousand gradient steps. One camera sees motion along its own axis only as a change of size:
that axis is determined far worse than the other two, and a ridge acts on it alone. The paper regularises the same
weakness by a penalty on |v_x| and |v_z|, which would also pull an oblique throw towards the vertical.

What the static kernels get wrong is the same in every frame: a body that is rendered one percent too large looks one
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

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.observation import Observation, Reconstruction
from neuma_lib.materials.base import Law
from neuma_lib.sim import MPMModel, rollout
from neuma_lib.sim.model import contact_clearance

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
    *,
    ridge: float = 0.02,
    initial_frames: int = 3,
    iterations: int = 30,
    difference: float = 0.02,
    progress: Callable[[int, int, float], None] | None = None,
) -> VelocityEstimate:
    """Estimate one velocity for the whole body from the frames before its first contact.

    Args:
        model: simulator constants.
        law: the prior material (before contact it does not matter which).
        body: reconstructed particles and kernels.
        observation: the video; frames from contact on are ignored.
        ridge: strength of the quadratic penalty on the velocity along the viewing direction of the first camera,
            relative to the curvature of the best determined axis. 0 switches it off.
        initial_frames: frames used for the first estimate (frame 0 included), which then tells how many more
            come before contact.
        iterations: largest number of Levenberg-Marquardt steps for each set of frames.
        difference: half width of the central differences [m/s].
        progress: called with (step, steps, loss).

    Raises:
        InputError: fewer than two frames, or the body touches a wall in the first frame.
    """
    if len(observation.frames) < 2:
        raise InputError("velocity needs at least two frames of the training view before contact")
    body, observation = body.to(torch.float64), observation.to(torch.float64)
    law = copy.deepcopy(law).to(torch.float64)
    if float(contact_clearance(model, body.x0)) <= 0:
        raise InputError("the body touches a wall in the first frame: the video must start before contact")
    axes = observation.cameras.viewmats[0, :3, :3].numpy()
    unknowns = np.zeros(6)  # velocity [m/s], and the nuisance in units of NUISANCE_SCALE
    used = list(range(min(initial_frames, len(observation.frames))))
    accepted = 0
    for _ in range(6):
        seen = observation.select(used)
        fit = _levenberg_marquardt(
            model, law, body, seen, unknowns, axes, ridge, iterations, difference, progress
        )
        unknowns, accepted = fit["unknowns"], accepted + fit["accepted"]
        wider = _frames_before_contact(model, body, observation, unknowns[:3])
        if wider == used or len(wider) < 2:
            break
        used = wider
    std, std_camera, information = _uncertainty(fit["J"], fit["r"], seen.images.shape, axes)
    return VelocityEstimate(
        v0=unknowns[:3],
        std=std,
        axes=axes,
        std_camera=std_camera,
        information=information,
        frames=seen.frames,
        nuisance=NUISANCE_SCALE * unknowns[3:],
        loss=float(np.sqrt(np.mean(fit["r"] ** 2))),
        iterations=accepted,
        ridge=ridge,
    )


def _render(
    model: MPMModel, law: Law, body: Reconstruction, seen: Observation, unknowns: np.ndarray
) -> Tensor:
    v0, nuisance = torch.as_tensor(unknowns).to(body.x0).split(3)
    right, down, enlargement = NUISANCE_SCALE * nuisance
    axes = seen.cameras.viewmats[0, :3, :3].to(body.x0)
    with torch.no_grad():
        path = rollout(model, law, body.x0, v0, body.mass, body.vol0, steps=seen.steps, frames=seen.frames)
        centre = path.x.mean(dim=1, keepdim=True)
        x = centre + (1 + enlargement) * (path.x - centre) + right * axes[0] + down * axes[1]
        return body.particle_gs(seen.cameras)(x, (1 + enlargement) * path.F)


def _levenberg_marquardt(
    model, law, body, seen, start, axes, ridge, iterations, difference, progress
) -> dict:
    """Minimise |r(v, nuisance)|^2 + ridge * curvature * (depth . v)^2, r = rendered - observed."""

    def residual(u):
        r = (_render(model, law, body, seen, u) - seen.images).flatten().cpu().numpy()
        if not np.isfinite(r).all():
            raise NonFiniteError("velocity", f"rendered images are not finite at v0 = {u[:3].tolist()}")
        return r

    def jacobian(u):
        columns = [residual(u + e) - residual(u - e) for e in difference * np.eye(6)]
        return np.stack(columns, axis=1) / (2 * difference)

    def penalty(H):
        P = np.zeros((6, 6))
        P[:3, :3] = ridge * np.linalg.eigvalsh(H[:3, :3])[-1] * np.outer(axes[2], axes[2])
        return P

    u, damping, accepted = start, 1e-3, 0
    r, J = residual(u), jacobian(u)
    for iteration in range(iterations):
        H = J.T @ J
        P = penalty(H)
        step = -np.linalg.solve(H + P + damping * np.diag(np.diag(H)), J.T @ r + P @ u)
        trial = u + step
        r_trial = residual(trial)
        if r_trial @ r_trial + trial @ P @ trial < r @ r + u @ P @ u:
            u, r, damping, accepted = trial, r_trial, max(damping / 5, 1e-9), accepted + 1
            J = jacobian(u)
        else:
            damping *= 8
        if progress:
            progress(iteration + 1, iterations, float(np.sqrt(np.mean(r**2))))
        if np.linalg.norm(step) < 1e-5 or damping > 1e6:
            break
    return {"unknowns": u, "r": r, "J": J, "accepted": accepted}


def _frames_before_contact(
    model: MPMModel, body: Reconstruction, observation: Observation, v0: np.ndarray
) -> list[int]:
    """Indices of the leading frames in which the body, flying freely with v0, is clear of every wall."""
    clear = []
    g = torch.tensor(model.gravity, dtype=body.x0.dtype)
    v = torch.as_tensor(v0, dtype=body.x0.dtype)
    for index, n in enumerate(observation.frames):
        x = body.x0 + n * model.dt * v + g * model.dt**2 * n * (n + 1) / 2
        if float(contact_clearance(model, x)) <= 0:
            break
        clear.append(index)
    return clear


def _uncertainty(J: np.ndarray, r: np.ndarray, shape: torch.Size, axes: np.ndarray):
    """Standard deviations of an unregularised fit whose residuals are correlated inside tiles of the image.

    Residuals come from what the static reconstruction cannot show, not from independent pixel noise: scores are
    summed over each tile in all frames before their outer products are added (the cluster-robust covariance
    H^-1 (sum_c g_c g_c^T) H^-1). The curvature that is left for the velocity when the nuisance is free is the Schur
    complement of H.
    """
    T, V, height, width, channels = shape
    H = J.T @ J
    rows, columns = -(-height // _TILE), -(-width // _TILE)
    tile = (np.arange(height) // _TILE)[:, None] * columns + (np.arange(width) // _TILE)[None]
    tile = (np.arange(V)[:, None, None] * rows * columns + tile[None])[None, ..., None]
    tile = np.broadcast_to(tile, (T, V, height, width, channels)).ravel()
    scores = np.stack([np.bincount(tile, weights=column * r) for column in J.T], axis=1)
    inverse = np.linalg.pinv(H)
    covariance = (inverse @ (scores.T @ scores) @ inverse)[:3, :3]
    in_camera = axes @ covariance @ axes.T
    curvature = 1 / np.diag(axes @ inverse[:3, :3] @ axes.T)
    return (
        np.sqrt(np.diag(covariance)),
        np.sqrt(np.diag(in_camera)),
        curvature / curvature.max(),
    )
