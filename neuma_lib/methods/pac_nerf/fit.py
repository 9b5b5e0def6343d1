"""Velocity and constants of a family of laws from a video: the later stages of PAC-NeRF (Li et al. 2023).

The radiance field of the first stage is fixed and represented by particles. L-BFGS estimates a uniform velocity from
frames before contact. Adam then fits the constants of the law, first on the frames until shortly after contact, then on
all. Every image is simulated, transferred to a lattice and rendered along rays, and gradients take the reverse path.
The constants and their parametrisation are in `families`.
"""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.methods.pac_nerf.carried_field import CarriedField
from neuma_lib.methods.pac_nerf.families import FamilyConstants
from neuma_lib.methods.pac_nerf.lattice import Lattice
from neuma_lib.methods.pac_nerf.options import PacNerfConfig
from neuma_lib.methods.pac_nerf.rendering import camera_rays, sum_of_terms
from neuma_lib.sim.model import COURANT_LIMIT, MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.observation import Observation

MAX_HALVINGS = 4  # maximum number of halvings of the time step
MIN_STEP = 1e-3
"""L-BFGS ends if a step changes every component of the velocity by at most this [m/s] (PAC-NeRF)."""
MIN_GAIN = 1e-6
"""Share of the first loss by which a step of L-BFGS must lower the loss, tied to `MIN_STEP` in torch."""
HISTORY = 20  # history size of L-BFGS (PAC-NeRF)


class Video:
    """Pixels of a video and their rays. Images stay as bytes and are converted one at a time."""

    def __init__(self, observation: Observation):
        self.frames = observation.frames
        self.views = [
            replace(observation, images=observation.images[:, view : view + 1], cameras=camera)
            for view, camera in enumerate(observation.cameras)
        ]
        self.rays = [camera_rays(view.cameras, 0) for view in self.views]

    def image(self, k: int, view: int) -> Tensor:
        """Colours (P, 3) over white of the pixels of a frame, row by row."""
        return self.views[view].colours(slice(k, k + 1)).flatten(0, 3)

    def shows_body(self, image: Tensor, view: int, lattice: Lattice) -> Tensor:
        """Indices of the pixels of an image that are not white, or whose ray intersects a lattice."""
        coloured = (image < 1 - 1 / 512).any(-1)
        return (coloured | lattice.intersected(*self.rays[view])).nonzero()[:, 0]

    def error(
        self,
        body: CarriedField,
        x: Tensor,
        k: int,
        view: int,
        pixels: int | None,
        generator: torch.Generator | None,
        frames: int = 1,
    ) -> Tensor:
        """Mean squared error of a frame for particles of the body at x (N, 3), divided by ``frames``: PAC-NeRF's loss.

        Estimated from at most ``pixels`` random pixels of those that show the body. The others are white in both
        images. Differentiable with respect to x. The gradient is computed during rendering, piece by piece
        (`rendering.POINTS_AT_ONCE`), so that the memory does not depend on the size of the image.
        """
        lattice, values = body.rendered.seen(x)
        image = self.image(k, view)
        chosen = self.shows_body(image, view, lattice)
        count = len(chosen)
        if pixels is not None and count > pixels:
            drawn = torch.randperm(count, generator=generator)[:pixels]
            chosen = chosen[drawn.to(chosen.device)]
        rays, observed = [part[chosen] for part in self.rays[view]], image[chosen]

        def terms(values):
            for part, colours, _ in body.field.render_in_pieces(lattice, values, *rays):
                squares = (colours - observed[part]).square().sum()
                yield squares * (count / max(1, len(chosen)) / len(image)) / frames

        return sum_of_terms(terms, values)


@dataclass
class PacNerfHistory:
    """Training curves with one entry per Adam step, before the step."""

    loss: list[float] = field(default_factory=list)  # loss of the frames, views and pixels of the step
    constants: dict[str, list[float]] = field(default_factory=dict)  # fitted constants by name
    halvings: list[int] = field(default_factory=list)  # halvings of the time step
    seconds: list[float] = field(default_factory=list)  # wall time [s]


@dataclass
class PacNerfFit:
    """Result of `fit_pac_nerf`."""

    velocity: Tensor  # velocity of all particles [m/s], shape (3,)
    velocity_losses: list[float]  # loss of every evaluation of L-BFGS
    constants: FamilyConstants  # constants of the law
    history: PacNerfHistory  # training curves of the constants
    particles: tuple[int, int]  # numbers of simulated and of rendered particles

    def summary(self) -> str:
        """Summary line for the log."""
        v, h = self.velocity.tolist(), self.history
        curves = ", ".join(
            f"{name} {curve[0]:.4g} -> {float(self.constants.values()[name].detach()):.4g}"
            for name, curve in h.constants.items()
        )
        return (
            f"v0 = ({v[0]:+.3f}, {v[1]:+.3f}, {v[2]:+.3f}) m/s in {len(self.velocity_losses)} evaluations; {curves} in"
            f" {len(h.loss)} steps; {self.particles[0]} of {self.particles[1]} particles simulated"
        )


def fit_pac_nerf(
    model: MPM,
    body: CarriedField,
    observation: Observation,
    contact: int,
    constants: FamilyConstants,
    settings: PacNerfConfig,
    seed: int = 0,
    *,
    checkpoint: Checkpoint | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    log: Callable[[str], None] = print,
) -> PacNerfFit:
    """Fit the velocity and the constants so that images of a body match a video.

    Args:
        model: grid, time step, gravity and walls.
        body: field and particles, whose precision is that of the fit.
        observation: the video with the views to use.
        contact: step of the last frame before contact.
        constants: initial constants of the law, fitted in place.
        seed: seed of the random views and pixels.
        checkpoint: file for the state, so that an interrupted fit can resume; None for none.
        progress: called with (step, steps, loss).

    Raises:
        InputError: no frame before or after contact, or initial constants too stiff for the shortest time step.
        NonFiniteError: a rollout diverges even with the shortest time step.
    """
    fit = _Fit(model, body, observation, contact, constants, settings, seed, log)
    if checkpoint is not None and (state := checkpoint.load()) is not None:
        fit.load_state_dict(state)
        log(f"resumed at step {fit.iteration} of {fit.iterations}")
    if fit.velocity is None:
        fit.fit_velocity()
        if checkpoint is not None:
            checkpoint.save(fit.state_dict())
    while fit.iteration < fit.iterations:
        fit.step()
        if progress is not None:
            progress(fit.iteration, fit.iterations, fit.history.loss[-1])
        if checkpoint is not None and fit.iteration % settings.save_every == 0:
            checkpoint.save(fit.state_dict())
    counts = len(body.moving.x), len(body.rendered.x)
    return PacNerfFit(fit.velocity, fit.velocity_losses, constants, fit.history, counts)


class _Fit:
    """State of the fit."""

    def __init__(self, model, body, observation, contact, constants, settings, seed, log):
        self.model, self.body, self.constants, self.settings, self.log = model, body, constants, settings, log
        self.video, self.contact = Video(observation), contact
        self.generator = torch.Generator().manual_seed(seed)
        before = [k for k, n in enumerate(observation.frames) if 0 < n <= contact]
        after = [k for k, n in enumerate(observation.frames) if n > contact]
        if not before or not after:
            raise InputError(
                "frames",
                f"{len(before)} before and {len(after)} after contact must both be at least 1, to fit velocity and law",
            )
        self._check_guess()
        warm = contact + round(settings.after_contact / model.dt)
        near = [k for k in after if observation.frames[k] <= warm] or after[:1]
        self.flying = spread(before, settings.velocity_frames)
        self.stages = [spread(near, settings.max_frames), spread(after, settings.max_frames)]
        self.iterations = settings.iterations_contact + settings.iterations_all
        self.optimizer = torch.optim.Adam(constants.groups(settings), betas=settings.betas)
        self.iteration, self.history = 0, PacNerfHistory()
        self.history.constants = {name: [] for name in constants.values()}
        self.velocity: Tensor | None = None
        self.velocity_losses: list[float] = []

    def _check_guess(self) -> None:
        """Raise InputError unless the initial law is stable with the shortest time step."""
        dt, rho = self.model.dt / 2**MAX_HALVINGS, float(self.body.state(torch.zeros(3)).density.min())
        number = replace(self.model, dt=dt).courant(self.constants.law(dt), rho)
        if not number <= COURANT_LIMIT:
            raise InputError(
                "pac_nerf.families",
                f"{self.constants.specification()} has a Courant number of {number:.3g} > {COURANT_LIMIT} even with "
                f"dt = {dt:g} s after {MAX_HALVINGS} halvings",
                "Use softer initial constants, or a smaller dt of the scene",
            )

    def fit_velocity(self) -> None:
        """Fit a uniform velocity, initially zero, to all views of some frames before contact."""
        velocity = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        settings = self.settings
        optimizer = torch.optim.LBFGS(
            [velocity], lr=1, max_iter=settings.velocity_iterations, history_size=HISTORY, tolerance_grad=0,
            tolerance_change=MIN_STEP, line_search_fn="strong_wolfe",
        )  # fmt: skip

        def evaluate():
            loss, _ = self._halving_steps(lambda halvings: self._velocity_loss(velocity, halvings))
            self.velocity_losses.append(loss)
            # torch uses one tolerance for step and loss
            scale = MIN_STEP / MIN_GAIN / max(self.velocity_losses[0], 1e-30)
            velocity.grad.mul_(scale)
            return torch.tensor(scale * loss, dtype=torch.float64)

        optimizer.step(evaluate)
        self.velocity = velocity.detach()
        self.log(f"v0 = {[round(v, 3) for v in self.velocity.tolist()]} m/s from {len(self.flying)} frames")

    def step(self) -> None:
        """One Adam step on the constants with one random view per frame."""
        started, settings = time.perf_counter(), self.settings
        late = self.iteration >= settings.iterations_contact
        for name, value in self.constants.values().items():
            self.history.constants[name].append(float(value.detach()))
        drawn = self.generator.get_state()

        def evaluate(halvings):
            self.generator.set_state(drawn)
            return self._loss(self.stages[late], halvings)

        loss, halvings = self._halving_steps(evaluate)
        if halvings and halvings != (self.history.halvings or [0])[-1]:
            self.log(f"step {self.iteration}: time steps of {self.model.dt / 2**halvings:g} s")
        decay = settings.rate_decay ** max(0.0, 2 * self.iteration / self.iterations - 1)
        for group in self.optimizer.param_groups:
            # far from the optimal modulus, Poisson's ratio would compensate for its error and recover slowly
            fixed = group["name"] == "nu" and self.iteration < settings.iterations_contact
            group["lr"] = 0.0 if fixed else decay * group["first_lr"]
        self.optimizer.step()
        self.history.loss.append(loss)
        self.history.halvings.append(halvings)
        self.history.seconds.append(time.perf_counter() - started)
        self.iteration += 1

    def _halving_steps(self, evaluate: Callable[[int], float]) -> tuple[float, int]:
        """A finite loss with its gradient, and the number of halvings of the time step that it needs."""
        for halvings in range(MAX_HALVINGS + 1):
            try:
                return evaluate(halvings), halvings
            except NonFiniteError as error:
                last = error
        raise NonFiniteError(
            "pac_nerf",
            f"{last}, even with dt = {self.model.dt / 2**MAX_HALVINGS:g} s. Lower pac_nerf.rate_modulus or use other "
            "initial constants",
        )

    def _velocity_loss(self, velocity: Tensor, halvings: int) -> float:
        """Mean loss of the frames before contact in all views, with its gradient by the velocity."""
        velocity.grad = None
        x, loss = self._positions(velocity, self.flying, halvings), 0.0
        leaf = x.detach().requires_grad_()
        for t, k in enumerate(self.flying):
            for view in range(len(self.video.rays)):
                error = self.video.error(self.body, leaf[t], k, view, None, None, len(self.flying))
                error.backward()
                loss += float(error.detach())
        x.backward(leaf.grad)
        return self._finite(loss, [velocity])

    def _positions(self, velocity: Tensor, chosen: Sequence[int], halvings: int) -> Tensor:
        """Positions of the rendered particles at the chosen frames, (T, N, 3), for a number of halvings."""
        model = replace(self.model, dt=self.model.dt / 2**halvings)
        frames = [self.video.frames[k] * 2**halvings for k in chosen]
        state = self.body.state(velocity)
        law = self.constants.law(model.dt, state.x.device)
        if (number := model.courant(law, float(state.density.min()))) > COURANT_LIMIT:
            problem = f"the Courant number of {self.constants.specification()} is {number:.2g}"
            raise NonFiniteError("pac_nerf", problem)
        return self.body.positions(rollout(model, law, state, steps=frames[-1], frames=frames).x)

    def _loss(self, chosen: Sequence[int], halvings: int) -> float:
        """Mean loss of the frames, each in a random view, with its gradient by the constants."""
        self.optimizer.zero_grad()
        x, loss = self._positions(self.velocity, chosen, halvings), 0.0
        if not x.requires_grad:
            raise InputError(
                "velocity",
                f"with {self.velocity.tolist()} m/s the body has no contact in the video that determines constants",
                "Check the radiance field, or omit this method",
            )
        leaf = x.detach().requires_grad_()
        for t, k in enumerate(chosen):
            view = int(torch.randint(len(self.video.rays), (), generator=self.generator))
            pixels = self.settings.pixels
            error = self.video.error(self.body, leaf[t], k, view, pixels, self.generator, len(chosen))
            error.backward()
            loss += float(error.detach())
        x.backward(leaf.grad)
        return self._finite(loss, self.constants.parameters())

    def _finite(self, loss: float, of: Iterable[Tensor]) -> float:
        if not (math.isfinite(loss) and all(bool(p.grad.isfinite().all()) for p in of)):
            problem = f"the loss or its gradient is not finite at step {self.iteration}"
            raise NonFiniteError("pac_nerf", problem)
        return loss

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next steps depend on."""
        return {
            "iteration": self.iteration,
            "velocity": self.velocity,
            "velocity_losses": self.velocity_losses,
            "constants": self.constants.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "history": dict(self.history.__dict__),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        for key in ("iteration", "velocity", "velocity_losses"):
            setattr(self, key, state[key])
        self.constants.load_state_dict(state["constants"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        self.history = PacNerfHistory(**state["history"])


def spread(items: Sequence[int], limit: int) -> list[int]:
    """At most ``limit`` items, evenly spaced, including the last one."""
    if len(items) <= limit:
        return list(items)
    return [items[round((i + 1) * len(items) / limit) - 1] for i in range(limit)]
