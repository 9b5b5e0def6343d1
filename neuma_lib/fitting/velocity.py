"""Initial velocity and spin from the frames before contact (paper Sec. 3.1), through renderer and simulator.

The unknowns are the velocity of the centre of mass and the angular velocity, so Levenberg-Marquardt with a numerical
Jacobian minimises the image residuals instead of a thousand gradient steps. One camera observes motion along its axis
only as a change of size. That component is much less certain than the others, and only it has a ridge penalty. The
paper penalises |v_x| and |v_z| instead, which biases oblique motions towards the vertical.

Errors of the static Gaussians are the same in every frame. A body rendered one percent too large appears one percent
too near, which would become a velocity of half a metre per second in depth. A constant shift and enlargement of the
rendered body are therefore estimated as nuisance parameters.

A spinning body stretches by an amount that depends on its unknown material: loose particles continue along straight
lines, a rigid body keeps its size. One camera cannot distinguish growth from approach: honey simulated as sand appears
to recede by half a metre per second. Two more nuisance parameters account for this: the looseness, a factor on the
difference between loose and rigid flight with a prior of 0 +- 1, and a shrinking along the spin axis, by which a
spreading fluid conserves its volume.

A spin that does not differ significantly from 0 is set to 0, with its standard deviation as an upper limit.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.coupling.filmed import Filmed
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.frame_batches import frame_batches, spread_frames
from neuma_lib.fitting.least_squares import Linearisation, block_sums, jackknife, levenberg_marquardt
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.body_contact import REACH
from neuma_lib.sim.colliders import contact_radius
from neuma_lib.sim.model import MPM, contact_clearance
from neuma_lib.sim.rigid_flight import rigid_flight
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, cross_matrix
from neuma_lib.splatting.observation import Observation, joint_frames, rendered_steps, select_frames, several

NUISANCE_SCALE = 0.02
"""Unit of the constant shift [m] and of the relative enlargement, equivalent to about 1 m/s over a few frames."""
UNKNOWNS = 11
"""Velocity and spin (world axes), shift right and down, enlargement, looseness and shrinking (`_Flight`)."""
_SPIN, _STRETCH = slice(3, 6), slice(9, 11)  # indices of the spin, and of looseness and shrinking
_ALL, _NO_SPIN = list(range(UNKNOWNS)), [0, 1, 2, 6, 7, 8]  # free unknowns with and without spin
_ROUNDS = 10  # maximum number of sets of frames and of simulations of a spinning body
_MIN_GAIN = 1e-5  # relative decrease of the cost at convergence, a hundredth of the uncertainty
_ROUGH_GAIN = 1e-3  # the same before all frames are used
_CONTACT_ROUNDS = 2  # estimates of several bodies from the frames before their predicted contacts
_MIN_TURN = 5e-3  # angle by which a change of the spin requires another simulation [rad]


@dataclass(frozen=True)
class VelocityEstimate:
    """Result of `estimate_velocity`.

    Attributes:
        v0: initial velocity of the centre [m/s], shape (3,).
        spin: angular velocity about the centre [rad/s], shape (3,).
        centre: centre of mass of the particles [m], shape (3,).
        std: standard deviation along each world axis without ridge penalty [m/s], shape (3,).
        axes: rows are the camera's right, down and viewing direction in world axes, shape (3, 3).
        std_camera: standard deviation along those axes [m/s], shape (3,).
        spin_std: standard deviation of the spin along each world axis [rad/s], shape (3,).
        spin_std_camera: standard deviation of the spin about the camera's axes [rad/s], shape (3,).
        information: curvature of the loss along the camera's axes relative to the best determined one, shape (3,).
        frames: steps of the frames used.
        nuisance: shift right and down of the rendered body [m], relative enlargement, looseness and shrinking,
            shape (5,).
        loss: root mean square image residual at the estimate.
        iterations: number of accepted Levenberg-Marquardt steps.
        ridge: weight of the ridge penalty.
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

    @classmethod
    def at_rest(cls, centre: np.ndarray, axes: np.ndarray) -> "VelocityEstimate":
        """The motion of a body that is held at the start, which is exact."""
        zero = np.zeros(3)
        exact = dict.fromkeys(
            ("v0", "spin", "std", "std_camera", "spin_std", "spin_std_camera", "information"), zero
        )
        return cls(
            **exact,
            centre=centre,
            axes=axes,
            frames=(),
            nuisance=np.zeros(5),
            loss=0.0,
            iterations=0,
            ridge=0.0,
        )

    def as_dict(self) -> dict:
        """Plain numbers and lists for JSON."""
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
        """Summary line for the log: estimate, uncertainty, and regularisation of the depth axis."""
        v, s, i = self.v0, self.std_camera, self.information
        w, t = self.spin, self.spin_std_camera
        ridge = f"ridge {self.ridge:g} on depth" if self.ridge else "no regularisation"
        return (
            f"v0 = ({v[0]:+.3f}, {v[1]:+.3f}, {v[2]:+.3f}) m/s from {len(self.frames)} frames before contact; "
            f"std right {s[0]:.3f}, down {s[1]:.3f}, depth {s[2]:.3f} m/s; "
            f"spin ({w[0]:+.2f}, {w[1]:+.2f}, {w[2]:+.2f}) rad/s, "
            f"std about these axes {t[0]:.2f}, {t[1]:.2f}, {t[2]:.2f} rad/s; "
            f"information {i[0]:.2f}, {i[1]:.2f}, {i[2]:.3f}; {ridge}"
        )


def estimate_velocity(
    model: MPM,
    law: Law,
    body: Reconstruction,
    observation: Observation | Sequence[Observation],
    settings: VelocityConfig,
    progress: Callable[[int, int, float], None] | None = None,
    others: Sequence[State] = (),
) -> VelocityEstimate:
    """Estimate the initial velocity and spin of a body from the frames before its first contact.

    A body that is clamped at the start is at rest.

    Args:
        model: simulator constants.
        law: the prior law, which affects only the stretch of a spinning body before contact.
        body: reconstructed particles and Gaussians.
        observation: the video, or several of the same motion by cameras of different times, sizes or exposures. Frames
            from the contact on are ignored.
        settings: hyper-parameters, with the ``views`` of the observation.
        progress: called with (step, steps, loss).
        others: initial states of other bodies in free flight, with which contact counts as well.

    Raises:
        InputError: fewer than two frames, or the body touches a wall in the first frame.
    """
    videos, precision = several(observation), body.x0.dtype
    frames = joint_frames(videos)
    if len(frames) < 2:
        raise InputError("frames", f"{len(frames)} of the training view before contact must be at least 2")
    videos, law = tuple(video.to(precision) for video in videos), copy.deepcopy(law).to(precision)
    axes = videos[0].cameras.viewmats[0, :3, :3].cpu().numpy()
    if model.clamps:
        return VelocityEstimate.at_rest((body.mass @ body.x0 / body.mass.sum()).cpu().numpy(), axes)
    if float(contact_clearance(model, body.x0, body.vol0)) <= 0:
        problem = "the body touches a wall in the first frame"
        raise InputError("frames", problem, "Start the video before the contact")
    ends = tuple(max(n + video.exposure[-1] for video in videos if n in video.frames) for n in frames)
    flight = _Flight(model, law, body, ends, others)
    minimise = partial(_minimise, axes=axes, settings=settings, progress=progress)
    unknowns, accepted = np.zeros(UNKNOWNS), 0
    used = min(settings.initial_frames, len(frames))
    growing = used < len(frames)
    for _ in range(_ROUNDS):
        # At most double the frames per round, because extrapolation of a spin is inaccurate.
        reach = min(2 * used, len(frames)) if growing else used
        flight.simulate(unknowns, rendered_steps(select_frames(videos, frames[:reach])))
        chosen = tuple(frames[k] for k in spread_frames(used, settings.frames))
        residuals = _Residuals(flight, select_frames(videos, chosen), settings.difference)
        unknowns, fit, steps = minimise(residuals, unknowns, _ALL, _ROUGH_GAIN if growing else _MIN_GAIN)
        accepted += steps
        clear = flight.frames_before_contact(unknowns, reach)
        converged = clear == used and not growing and flight.turn(unknowns, chosen) < _MIN_TURN
        if clear < 2 or converged:
            break
        used, growing = clear, growing and clear == reach < len(frames)
    covariance, information = _uncertainty(fit, flight, chosen, axes, settings)
    w = unknowns[_SPIN]
    if w @ np.linalg.solve(covariance[_SPIN, _SPIN], w) <= settings.spin_significance:
        unknowns[_SPIN] = unknowns[_STRETCH] = 0.0
        flight.simulate(unknowns, residuals.steps)
        unknowns, fit, steps = minimise(residuals, unknowns, _NO_SPIN, _MIN_GAIN)
        accepted += steps
    v0, spin = (vector.cpu().numpy() for vector in flight.motion(unknowns))
    covariance *= np.outer(flight.units, flight.units)
    std, spin_std, std_camera, spin_std_camera = (
        np.sqrt(np.diag(basis @ covariance[part, part] @ basis.T))
        for basis in (np.eye(3), axes)
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


def estimate_velocities(
    model: MPM,
    law: Law,
    bodies: Sequence[Reconstruction],
    videos: Sequence[Sequence[Observation]],
    settings: VelocityConfig,
    progress: Callable[[int, int, float], None] | None = None,
) -> list[VelocityEstimate]:
    """`estimate_velocity` of each of several bodies, which also touch each other.

    When they do follows from the motion of all. It is estimated from the first frames alone, and then from those before
    the contacts that the last estimates predict.

    Args:
        bodies: reconstructed particles and Gaussians of each body.
        videos: of each body, with the pixels that other bodies hide (`Observation.hidden`).
    """
    model = replace(model, pairs=())  # bodies that fly are simulated alone
    first = [select_frames(own, joint_frames(own)[: settings.initial_frames]) for own in videos]
    pairs = zip(bodies, first, strict=True)
    estimates = [estimate_velocity(model, law, body, own, settings) for body, own in pairs]
    total = _CONTACT_ROUNDS * len(bodies)
    for done in range(total):
        k = done % len(bodies)
        states = [
            InitialMotion.of(each.as_dict()).of_body(body)
            for each, body in zip(estimates, bodies, strict=True)
        ]
        others = [*states[:k], *states[k + 1 :]]
        estimates[k] = estimate_velocity(model, law, bodies[k], videos[k], settings, others=others)
        if progress:
            progress(done + 1, total, estimates[k].loss)
    return estimates


class _Flight:
    """Free flight of the body: the simulated motion of a spinning body, moved along a parabola.

    In free flight the centre of mass moves on a parabola, independently of the rotation, simulated without gravity
    in the middle of the cube, far from walls.

    Attributes:
        ends: step at which the exposure of each frame ends.
        centre: centre of mass [m], shape (3,).
        units: units (11,) of the unknowns with similar effects on the images: 1 m/s, the spin with a root mean square
            velocity of 1 m/s about the centre, `NUISANCE_SCALE`, 1 and 1.
    """

    def __init__(
        self, model: MPM, law: Law, body: Reconstruction, ends: tuple[int, ...], others: Sequence[State] = ()
    ):
        self.model, self.law, self.body, self.ends = model, law, body, ends
        self._others = [(rigid_flight(model, state, ends).x, state.vol0) for state in others]
        self.centre = body.mass @ body.x0 / body.mass.sum()
        gyration = ((body.x0 - self.centre).square().sum(1) @ body.mass / body.mass.sum()).sqrt()
        self.units = np.append(np.repeat([1.0, 1.0 / float(gyration), NUISANCE_SCALE], 3), [1.0, 1.0])
        box = torch.stack([body.x0.amin(dim=0), body.x0.amax(dim=0)])
        self._to_middle = 0.5 - box.mean(dim=0)
        self._in_middle = replace(body, x0=body.x0 + self._to_middle)
        self._weightless = replace(model, gravity=(0.0, 0.0, 0.0), colliders=())
        self._near, self._path = torch.zeros_like(self.centre), None

    def motion(self, unknowns: np.ndarray) -> tuple[Tensor, Tensor]:
        """Velocity [m/s] and spin [rad/s] of scaled unknowns."""
        return torch.as_tensor((self.units * unknowns)[:6]).to(self.body.x0).split(3)

    def simulate(self, unknowns: np.ndarray, frames: tuple[int, ...]) -> None:
        """Simulate the rotation for the spin of the unknowns, unless an existing simulation is accurate enough.

        Initially that is a body at rest, which needs no simulation.
        """
        reached = self._path is None or set(self._path.frames).issuperset(frames)
        if reached and self.turn(unknowns, frames) < _MIN_TURN:
            return
        _, self._near = self.motion(unknowns)
        self._path = None
        if self._near.any():
            start = self._in_middle.state(torch.zeros_like(self._near), self._near)
            with torch.no_grad():
                self._path = rollout(self._weightless, self.law, start, steps=frames[-1], frames=frames)

    def turn(self, unknowns: np.ndarray, frames: tuple[int, ...]) -> float:
        """Angle between rotations by the spin of the unknowns and the simulated one at the last frame [rad]."""
        _, spin = self.motion(unknowns)
        return float(frames[-1] * self.model.dt * (spin - self._near).norm())

    def __call__(
        self, v0: Tensor, spin: Tensor, frames: tuple[int, ...], stretch: Sequence[float] = (0.0, 0.0)
    ) -> tuple[Tensor, Tensor]:
        """Positions (T, N, 3) [m] and deformation gradients (T, N, 3, 3) of the particles at the frames.

        The simulated body is rigidly rotated by the angle between its spin and the given one, which avoids a simulation
        per evaluation. The neglected effect of the change of spin, by stretch and by unequal moments of inertia, is
        smaller by a factor of the rotation angle. `stretch` adds the looseness times the difference between loose
        flight, x0 + t omega x x0, and rigid flight, and the shrinking times -(t^2 / 2) omega omega^T x0.
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

    def frames_before_contact(self, unknowns: np.ndarray, count: int) -> int:
        """Number of the first `count` frames that end before the body touches a wall or another body."""
        x, _ = self(*self.motion(unknowns), self.ends[:count])
        touching = contact_clearance(self.model, x, self.body.vol0, self.ends[:count]) <= 0
        reach = REACH * self.model.dx + contact_radius(self.body.vol0).max()
        for other, vol0 in self._others:
            gaps = (_distance(own, at) for own, at in zip(x, other, strict=False))
            touching |= torch.stack([*gaps]) <= reach + contact_radius(vol0).max()
        return int(touching.int().argmax()) if touching.any() else len(x)


def _distance(a: Tensor, b: Tensor) -> Tensor:
    """Smallest distance [m] between points (N, 3) and (M, 3) [m]."""
    return torch.as_tensor(cKDTree(a.cpu().numpy()).query(b.cpu().numpy())[0].min()).to(a)


@dataclass
class _Residuals:
    """Rendered minus observed colours as a function of the unknowns, evaluated in batches of frames."""

    flight: _Flight
    videos: tuple[Observation, ...]
    difference: float

    def __post_init__(self):
        self.steps = rendered_steps(self.videos)
        self._filmed = [
            Filmed(self.flight.body.particle_gs(video.cameras), video, self.steps) for video in self.videos
        ]
        self._axes = self.videos[0].cameras.viewmats[0, :3, :3]

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squares."""
        return self._checked(
            sum(
                self._residual(unknowns, k, part).square().sum().double()
                for k in range(len(self.videos))
                for part in self._parts(k)
            ),
            unknowns,
        )

    def linearise(
        self, unknowns: np.ndarray, free: Sequence[int] = _ALL, exact: bool = True
    ) -> Linearisation:
        """Sums of the residuals and of their central differences, 0 for unknowns that are not free."""
        cost, count, sums = 0.0, 0, []
        for video in range(len(self.videos)):
            curvatures, scores = 0.0, 0.0
            for part in self._parts(video):
                r = self._residual(unknowns, video, part)
                columns = [torch.zeros_like(r)] * UNKNOWNS
                for k in free:
                    e = self.difference * np.eye(UNKNOWNS)[k]
                    change = self._render(unknowns + e, video, part) - self._render(unknowns - e, video, part)
                    columns[k] = change / (2 * self.difference)
                cost, count = cost + r.square().sum().double(), count + r.numel()
                curvature, score = block_sums(columns, r)
                curvatures, scores = curvatures + curvature, scores + score
            sums.append((curvatures, scores))
        cost = self._checked(cost, unknowns)
        curvatures, scores = (np.concatenate(of_all) for of_all in zip(*sums, strict=True))
        return Linearisation(curvatures, scores, cost, float(np.sqrt(cost / count)))

    def _parts(self, video: int):
        return frame_batches(len(self.videos[video].frames), self._filmed[video].batch)

    def _residual(self, unknowns: np.ndarray, video: int, part: slice) -> Tensor:
        return self._render(unknowns, video, part) - self.videos[video].colours(part)

    def _render(self, unknowns: np.ndarray, video: int, part: slice) -> Tensor:
        v0, spin = self.flight.motion(unknowns)
        right, down, enlargement, *stretch = torch.as_tensor(self.flight.units * unknowns).to(v0)[6:]
        observed, axes = self.videos[video], self._axes
        exposed = len(observed.exposure)
        steps = tuple(n + k for n in observed.frames[part] for k in observed.exposure)
        with torch.no_grad():
            x, F = self.flight(v0, spin, steps, stretch)
            centre = x.mean(dim=1, keepdim=True)
            x = centre + (1 + enlargement) * (x - centre) + right * axes[0] + down * axes[1]
            F = (1 + enlargement) * F
            if exposed > 1:
                x, F = (state.unflatten(0, (-1, exposed)) for state in (x, F))
            return self._filmed[video](x, F, part)

    def _checked(self, cost: Tensor, unknowns: np.ndarray) -> float:
        value = float(cost)
        if not np.isfinite(value):
            problem = f"rendered images are not finite at v0 = {unknowns[:3].tolist()}"
            raise NonFiniteError("velocity", problem)
        return value


def _prior(fit: Linearisation) -> np.ndarray:
    """Curvature (11, 11) of the prior 0 +- 1 of looseness and shrinking."""
    curvature = np.zeros(UNKNOWNS)
    curvature[_STRETCH] = fit.block_cost
    return np.diag(curvature)


def _minimise(
    residuals: _Residuals,
    start: np.ndarray,
    free: Sequence[int],
    min_gain: float,
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
        return P + _prior(fit)

    u, fit, accepted = levenberg_marquardt(
        residuals, start, free, penalty, min_gain, settings.iterations, progress
    )
    return u, fit if free is _ALL else residuals.linearise(u), accepted


def _uncertainty(
    fit: Linearisation, flight: _Flight, frames: tuple[int, ...], axes: np.ndarray, settings: VelocityConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Jackknife covariance (11, 11) of a fit of all unknowns without ridge, and the information (3,) on the velocity
    along the camera's axes.

    The covariance includes the prior uncertainty of looseness and shrinking. The information is from the Schur
    complement of H, i.e. with all other unknowns free. Errors common to all blocks, such as shading that does not
    rotate with the body, correspond to a rotation by `angle_std`, which is added to the uncertainty of the spin.
    """
    H, P = fit.curvature, _prior(fit)
    inverse = np.linalg.pinv(H + P)
    by_prior = (inverse @ P)[:, _STRETCH]
    information = 1 / np.diag(axes @ inverse[:3, :3] @ axes.T)
    covariance = jackknife(fit, P) + by_prior @ by_prior.T
    duration = flight.model.dt * (frames[-1] - frames[0])
    covariance[_SPIN, _SPIN] += np.diag((settings.angle_std / duration / flight.units[_SPIN]) ** 2)
    return covariance, information / information.max()
