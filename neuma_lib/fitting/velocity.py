"""Initial velocity and spin from the frames before contact (paper Sec. 3.1), through renderer and simulator.

The unknowns are the velocity of the centre of mass and the angular velocity about it, so the image residuals are
minimised by Levenberg-Marquardt with a numerical Jacobian instead of a thousand gradient steps. One camera sees motion
along its own axis only as a change of size: that axis is determined far worse than the other two, and a ridge acts on
it alone. The paper regularises the same weakness by a penalty on |v_x| and |v_z|, which would also pull an oblique
throw towards the vertical.

What the static Gaussians get wrong is the same in every frame: a body that is rendered one percent too large looks one
percent too near. Taken for motion, that would be half a metre per second in depth. A constant shift of the rendered
body is therefore estimated beside the motion, and thrown away.

A body that spins stretches, and the prior, which is wrong, does not say how far: a part that is held by nothing flies
straight on, a rigid body keeps its size. Seen by one camera, growth is approach: honey that is taken for sand seems to
recede by half a metre per second. So the difference between loose and rigid flight is added with a factor of its own,
the looseness, which is 0 if the prior is right and expected within +-1; and beside it a shrinking along the axis of the
spin, by which a fluid keeps its volume while it spreads.

Many bodies do not spin. A spin that is not told from 0 is none, and its standard deviation says how large it may be.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.coupling.filmed import Filmed
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.frame_batches import frame_batches, spread_frames
from neuma_lib.fitting.least_squares import Linearisation, in_blocks, jackknife, levenberg_marquardt
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPM, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import cross_matrix
from neuma_lib.splatting.observation import (
    Observation,
    joint_frames,
    rendered_steps,
    select_frames,
    several,
)

NUISANCE_SCALE = 0.02
"""Unit of the constant shift [m] and of the relative enlargement: about 1 m/s over a few frames."""
UNKNOWNS = 11
"""Velocity and spin (world axes), shift to the right and down, enlargement, looseness and shrinking (`_Flight`)."""
_SPIN, _STRETCH = slice(3, 6), slice(9, 11)  # places of the spin, and of looseness and shrinking
_ALL, _STILL = list(range(UNKNOWNS)), [0, 1, 2, 6, 7, 8]  # what is free, and what if the body does not spin
_ROUNDS = 10  # sets of frames, and simulations of a spinning body
_LEAST_GAIN = 1e-5  # part of the squares that a step may save at the end: a hundredth of the uncertainty
_ROUGH_GAIN = 1e-3  # the same while more frames are to come
_LEAST_TURN = 5e-3  # angle [rad] of a change of spin that calls for another simulation


@dataclass(frozen=True)
class VelocityEstimate:
    """Result of `estimate_velocity`.

    Attributes:
        v0: initial velocity of the centre [m/s], shape (3,).
        spin: angular velocity about the centre [rad/s], shape (3,).
        centre: centre of mass of the particles [m], shape (3,).
        std: estimated standard deviation along each world axis [m/s], shape (3,), without the ridge's help.
        axes: rows are the camera's right, down and viewing direction in world axes, shape (3, 3).
        std_camera: standard deviation along those axes [m/s], shape (3,).
        spin_std: standard deviation of the spin along each world axis [rad/s], shape (3,).
        spin_std_camera: standard deviation of the spin about the camera's axes [rad/s], shape (3,).
        information: curvature of the loss along the camera's axes relative to the best determined one, shape (3,).
        frames: steps of the frames that were used.
        nuisance: what was estimated along: constant shift of the rendered body to the right and down [m], its
            relative enlargement, its looseness and its shrinking, shape (5,).
        loss: root mean square image residual at the estimate.
        iterations: accepted Levenberg-Marquardt steps.
        ridge: the ridge that was used (0: none).
    """

    v0: np.ndarray
    spin: np.ndarray
    centre: np.ndarray
    std: np.ndarray
    axes: np.ndarray
    std_camera: np.ndarray
    spin_std: np.ndarray
    spin_std_camera: np.ndarray
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
            "angular_velocity": self.spin.tolist(),
            "centre": self.centre.tolist(),
            "units": {"v0": "m/s", "angular_velocity": "rad/s", "centre": "m"},
            "std": self.std.tolist(),
            "camera_axes": self.axes.tolist(),
            "std_camera": self.std_camera.tolist(),
            "angular_velocity_std": self.spin_std.tolist(),
            "angular_velocity_std_camera": self.spin_std_camera.tolist(),
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
        w, t = self.spin, self.spin_std_camera
        held = f"ridge {self.ridge:g} on depth" if self.ridge else "no regularisation"
        return (
            f"v0 = ({v[0]:+.3f}, {v[1]:+.3f}, {v[2]:+.3f}) m/s from {len(self.frames)} frames before contact; "
            f"std right {s[0]:.3f}, down {s[1]:.3f}, depth {s[2]:.3f} m/s; "
            f"spin ({w[0]:+.2f}, {w[1]:+.2f}, {w[2]:+.2f}) rad/s, "
            f"std about these axes {t[0]:.2f}, {t[1]:.2f}, {t[2]:.2f} rad/s; "
            f"information {i[0]:.2f}, {i[1]:.2f}, {i[2]:.3f}; {held}"
        )


def estimate_velocity(
    model: MPM,
    law: Law,
    body: Reconstruction,
    observation: Observation | Sequence[Observation],
    settings: VelocityConfig,
    progress: Callable[[int, int, float], None] | None = None,
) -> VelocityEstimate:
    """Estimate one velocity for the whole body from the frames before its first contact.

    Args:
        model: simulator constants.
        law: the prior material; before contact it matters only by how far a spinning body stretches.
        body: reconstructed particles and Gaussians.
        observation: the video, or several of the same throw by cameras of other times, sizes or exposures; frames from
            contact on are ignored.
        settings: hyper-parameters; its ``views`` are those of the observation.
        progress: called with (step, steps, loss).

    Raises:
        InputError: fewer than two frames, or the body touches a wall in the first frame.
    """
    videos, precision = several(observation), body.x0.dtype
    frames = joint_frames(videos)
    if len(frames) < 2:
        raise InputError("velocity needs at least two frames of the training view before contact")
    videos, law = tuple(video.to(precision) for video in videos), copy.deepcopy(law).to(precision)
    if float(contact_clearance(model, body.x0)) <= 0:
        raise InputError("the body touches a wall in the first frame: the video must start before contact")
    axes = videos[0].cameras.viewmats[0, :3, :3].cpu().numpy()
    ends = tuple(max(n + video.exposure[-1] for video in videos if n in video.frames) for n in frames)
    flight = _Flight(model, law, body, ends)
    minimise = partial(_minimise, axes=axes, settings=settings, progress=progress)
    unknowns, accepted = np.zeros(UNKNOWNS), 0
    used = min(settings.initial_frames, len(frames))
    growing = used < len(frames)
    for _ in range(_ROUNDS):
        # No more than twice as many at a time: a spin from three frames says little about thirty.
        reach = min(2 * used, len(frames)) if growing else used
        flight.simulate(unknowns, rendered_steps(select_frames(videos, frames[:reach])))
        chosen = tuple(frames[k] for k in spread_frames(used, settings.frames))
        residuals = _Residuals(flight, select_frames(videos, chosen), settings.difference)
        unknowns, fit, steps = minimise(residuals, unknowns, _ALL, _ROUGH_GAIN if growing else _LEAST_GAIN)
        accepted += steps
        clear = flight.frames_before_contact(unknowns, reach)
        settled = clear == used and not growing and flight.turned(unknowns, chosen) < _LEAST_TURN
        if clear < 2 or settled:
            break
        used, growing = clear, growing and clear == reach < len(frames)
    covariance, information = _uncertainty(fit, flight, chosen, axes, settings)
    w = unknowns[_SPIN]
    if w @ np.linalg.solve(covariance[_SPIN, _SPIN], w) <= settings.spin_significance:
        unknowns[_SPIN] = unknowns[_STRETCH] = 0.0
        flight.simulate(unknowns, residuals.steps)
        unknowns, fit, steps = minimise(residuals, unknowns, _STILL, _LEAST_GAIN)
        accepted += steps
    v0, spin = (vector.cpu().numpy() for vector in flight.motion(unknowns))
    covariance *= np.outer(flight.units, flight.units)
    std, spin_std, std_camera, spin_std_camera = (
        np.sqrt(np.diag(turn @ covariance[part, part] @ turn.T))
        for turn in (np.eye(3), axes)
        for part in (slice(0, 3), _SPIN)
    )
    return VelocityEstimate(
        v0=v0,
        spin=spin,
        centre=flight.centre.cpu().numpy(),
        std=std,
        axes=axes,
        std_camera=std_camera,
        spin_std=spin_std,
        spin_std_camera=spin_std_camera,
        information=information,
        frames=chosen,
        nuisance=(flight.units * unknowns)[6:],
        loss=fit.rms,
        iterations=accepted,
        ridge=settings.ridge,
    )


class _Flight:
    """Free flight of the body: the motion that the simulator makes of a spin, carried along a parabola.

    The spinning is simulated without weight in the middle of the cube, far from walls: in free flight the centre of
    mass follows its parabola whatever the body does about it.

    Attributes:
        ends: step at which the exposure of each frame ends.
        centre: centre of mass [m], shape (3,).
        units: of the unknowns, shape (11,): 1 m/s, the spin that moves the particles by 1 m/s about their centre (root
            mean square), `NUISANCE_SCALE`, 1 and 1. So all have effects of the same order on the images.
    """

    def __init__(self, model: MPM, law: Law, body: Reconstruction, ends: tuple[int, ...]):
        self.model, self.law, self.body, self.ends = model, law, body, ends
        self.centre = body.mass @ body.x0 / body.mass.sum()
        gyration = ((body.x0 - self.centre).square().sum(1) @ body.mass / body.mass.sum()).sqrt()
        self.units = np.append(np.repeat([1.0, 1.0 / float(gyration), NUISANCE_SCALE], 3), [1.0, 1.0])
        box = torch.stack([body.x0.amin(dim=0), body.x0.amax(dim=0)])
        self._to_middle = 0.5 - box.mean(dim=0)
        self._in_middle = replace(body, x0=body.x0 + self._to_middle)
        self._weightless = replace(model, gravity=(0.0, 0.0, 0.0))
        self._near, self._path = torch.zeros_like(self.centre), None

    def motion(self, unknowns: np.ndarray) -> tuple[Tensor, Tensor]:
        """Velocity [m/s] and spin [rad/s] of scaled unknowns."""
        return torch.as_tensor((self.units * unknowns)[:6]).to(self.body.x0).split(3)

    def simulate(self, unknowns: np.ndarray, frames: tuple[int, ...]) -> None:
        """Let the body spin in the middle of the cube as the unknowns say, unless what is known of it is good enough.

        What is known at first is a body at rest: it needs no simulation.
        """
        reached = self._path is None or set(self._path.frames).issuperset(frames)
        if reached and self.turned(unknowns, frames) < _LEAST_TURN:
            return
        _, self._near = self.motion(unknowns)
        self._path = None
        if self._near.any():
            start = self._in_middle.state(torch.zeros_like(self._near), self._near)
            with torch.no_grad():
                self._path = rollout(self._weightless, self.law, start, steps=frames[-1], frames=frames)

    def turned(self, unknowns: np.ndarray, frames: tuple[int, ...]) -> float:
        """Angle [rad] by which the spin of the unknowns and the simulated one come apart until the last frame."""
        _, spin = self.motion(unknowns)
        return float(frames[-1] * self.model.dt * (spin - self._near).norm())

    def __call__(
        self, v0: Tensor, spin: Tensor, frames: tuple[int, ...], stretch: Sequence[float] = (0.0, 0.0)
    ) -> tuple[Tensor, Tensor]:
        """Positions (T, N, 3) [m] and deformation gradients (T, N, 3, 3) of the particles at the frames.

        What was simulated is turned rigidly by the angle between its spin and this one. What a change of the spin
        does beyond this, by stretching the body and by unequal moments of inertia, is smaller by a factor of the
        angle that the body turns, and the fit is spared a simulation at every try. Added to both is
        `stretch`: the looseness times the difference between loose flight, x0 + t omega x x0, and rigid flight, and
        the shrinking times -(t^2 / 2) omega omega^T x0.
        """
        dt, g = self.model.dt, torch.tensor(self.model.gravity).to(v0)
        n = torch.tensor(frames).to(v0)[:, None, None]
        rate = n * dt * cross_matrix(spin)
        turn = torch.linalg.matrix_exp(rate) @ torch.linalg.matrix_exp(-n * dt * cross_matrix(self._near))
        if self._path is None:
            x, F = (self.body.x0 - self.centre) @ turn.mT, turn[:, None].expand(-1, len(self.body.x0), -1, -1)
        else:
            path = self._path.at(frames)
            x, F = (path.x - self.centre - self._to_middle) @ turn.mT, turn[:, None] @ path.F
        loose = torch.eye(3).to(rate) + rate - torch.linalg.matrix_exp(rate)
        added = stretch[0] * loose - stretch[1] / 2 * (n * dt) ** 2 * torch.outer(spin, spin)
        x, F = x + (self.body.x0 - self.centre) @ added.mT, F + added[:, None]
        return x + self.centre + n * dt * v0 + g * dt**2 * n * (n + 1) / 2, F

    def frames_before_contact(self, unknowns: np.ndarray, most: int) -> int:
        """How many of the first `most` frames end before the body touches a wall."""
        x, _ = self(*self.motion(unknowns), self.ends[:most])
        touching = contact_clearance(self.model, x) <= 0
        return int(touching.int().argmax()) if touching.any() else len(x)


@dataclass
class _Residuals:
    """Rendered minus observed colours as a function of the unknowns. A few frames at a time are in memory."""

    flight: _Flight
    seen: tuple[Observation, ...]
    difference: float

    def __post_init__(self):
        self.steps = rendered_steps(self.seen)
        self._filmed = [
            Filmed(self.flight.body.particle_gs(video.cameras), video, self.steps) for video in self.seen
        ]
        self._axes = self.seen[0].cameras.viewmats[0, :3, :3]

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squares."""
        return self._checked(
            sum(
                self._residual(unknowns, k, part).square().sum().double()
                for k in range(len(self.seen))
                for part in self._parts(k)
            ),
            unknowns,
        )

    def linearise(self, unknowns: np.ndarray, free: Sequence[int] = _ALL) -> Linearisation:
        """Sums of the residuals and of their central differences, which are 0 for unknowns that are not free."""
        cost, count, sums = 0.0, 0, []
        for video in range(len(self.seen)):
            curvatures, scores = 0.0, 0.0
            for part in self._parts(video):
                r = self._residual(unknowns, video, part)
                columns = torch.zeros(*in_blocks(r).shape, UNKNOWNS).to(r)  # (blocks, pixels, 11)
                for k in free:
                    e = self.difference * np.eye(UNKNOWNS)[k]
                    change = self._render(unknowns + e, video, part) - self._render(unknowns - e, video, part)
                    columns[..., k] = in_blocks(change / (2 * self.difference))
                cost, count = cost + r.square().sum().double(), count + r.numel()
                curvatures = curvatures + (columns.mT @ columns).double()
                scores = scores + (columns.mT @ in_blocks(r)[..., None])[..., 0].double()
            sums.append((curvatures.cpu().numpy(), scores.cpu().numpy()))
        cost = self._checked(cost, unknowns)
        curvatures, scores = (np.concatenate(of_all) for of_all in zip(*sums, strict=True))
        return Linearisation(curvatures, scores, cost, float(np.sqrt(cost / count)))

    def _parts(self, video: int):
        return frame_batches(len(self.seen[video].frames), self._filmed[video].batch)

    def _residual(self, unknowns: np.ndarray, video: int, part: slice) -> Tensor:
        return self._render(unknowns, video, part) - self.seen[video].colours(part)

    def _render(self, unknowns: np.ndarray, video: int, part: slice) -> Tensor:
        v0, spin = self.flight.motion(unknowns)
        right, down, enlargement, *stretch = torch.as_tensor(self.flight.units * unknowns).to(v0)[6:]
        seen, axes = self.seen[video], self._axes
        exposed = len(seen.exposure)
        steps = tuple(n + k for n in seen.frames[part] for k in seen.exposure)
        with torch.no_grad():
            x, F = self.flight(v0, spin, steps, stretch)
            centre = x.mean(dim=1, keepdim=True)
            x = centre + (1 + enlargement) * (x - centre) + right * axes[0] + down * axes[1]
            F = (1 + enlargement) * F
            if exposed > 1:
                x, F = (state.unflatten(0, (-1, exposed)) for state in (x, F))
            return self._filmed[video](x, F)

    def _checked(self, cost: Tensor, unknowns: np.ndarray) -> float:
        value = float(cost)
        if not np.isfinite(value):
            raise NonFiniteError(
                "velocity", f"rendered images are not finite at v0 = {unknowns[:3].tolist()}"
            )
        return value


def _held(fit: Linearisation) -> np.ndarray:
    """Curvature that holds looseness and shrinking at 0 +- 1, shape (11, 11)."""
    held = np.zeros(UNKNOWNS)
    held[_STRETCH] = fit.block_cost
    return np.diag(held)


def _minimise(
    residuals: _Residuals,
    start: np.ndarray,
    free: Sequence[int],
    least_gain: float,
    axes: np.ndarray,
    settings: VelocityConfig,
    progress: Callable[[int, int, float], None] | None,
) -> tuple[np.ndarray, Linearisation, int]:
    """Minimise |r(u)|^2 + ridge * curvature * (depth . v)^2 over the free unknowns.

    Returns:
        The unknowns (11,), the linearisation in all of them, and the number of accepted steps.
    """

    def penalty(fit):
        P = np.zeros((UNKNOWNS, UNKNOWNS))
        P[:3, :3] = (
            settings.ridge * np.linalg.eigvalsh(fit.curvature[:3, :3])[-1] * np.outer(axes[2], axes[2])
        )
        return P + _held(fit)

    u, fit, accepted = levenberg_marquardt(
        residuals, start, free, penalty, least_gain, settings.iterations, progress
    )
    return u, fit if free is _ALL else residuals.linearise(u), accepted


def _uncertainty(
    fit: Linearisation, flight: _Flight, frames: tuple[int, ...], axes: np.ndarray, settings: VelocityConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance (11, 11) of an unregularised fit of all unknowns, by the jackknife over blocks of the image, and the
    information on the velocity along the camera's axes (3,).

    Where looseness and shrinking are held at 0, the error of that, 1, is passed on. The curvature that is left for
    the velocity when the rest is free is the Schur complement of H.

    What is wrong in every block alike, such as shading that stays with the light while the body turns, shows as a
    turn by `angle_std`, which adds to the uncertainty of the spin.
    """
    H, P = fit.curvature, _held(fit)
    inverse = np.linalg.pinv(H + P)
    by_prior = (inverse @ P)[:, _STRETCH]
    information = 1 / np.diag(axes @ inverse[:3, :3] @ axes.T)
    covariance = jackknife(fit, P) + by_prior @ by_prior.T
    duration = flight.model.dt * (frames[-1] - frames[0])
    covariance[_SPIN, _SPIN] += np.diag((settings.angle_std / duration / flight.units[_SPIN]) ** 2)
    return covariance, information / information.max()
