"""Velocity and constants of a named family of laws from a video: the later stages of PAC-NeRF (Li et al. 2023).

A radiance field stays as the first stage has left it. Particles carry it: first one velocity for all of them is found
in frames before contact, by L-BFGS; then the constants of the law, by Adam, first in the frames until a little after
contact, then in all. Every picture goes through the simulation, back to a lattice and along rays, and gradients go the
same way back. Which constants, and how they are stored, is in `pac_families`.
"""

from __future__ import annotations

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

MOST_HALVINGS = 4
"""Times that a time step is halved before a rollout counts as unstable."""
LEAST_STEP = 1e-3
"""L-BFGS ends where a step changes no component of the velocity by more than this [m/s] (PAC-NeRF)."""
LEAST_GAIN = 1e-6
"""Or, as torch's knows no other way, where it lowers the loss by less than this part of the first one."""
HISTORY = 20
"""Steps that L-BFGS remembers (PAC-NeRF)."""


class Video:
    """Pixels of a video and their rays. Images stay as they are stored: bytes become colours a picture at a time."""

    def __init__(self, observation: Observation):
        self.frames = observation.frames
        self.views = [
            replace(observation, images=observation.images[:, view : view + 1], cameras=camera)
            for view, camera in enumerate(observation.cameras)
        ]
        self.rays = [camera_rays(view.cameras, 0) for view in self.views]

    def picture(self, k: int, view: int) -> Tensor:
        """Colours (P, 3) over white of the pixels of a frame, row by row."""
        return self.views[view].colours(slice(k, k + 1)).flatten(0, 3)

    def shows_body(self, picture: Tensor, view: int, lattice: Lattice) -> Tensor:
        """Indices of the pixels of a picture that are not white, or whose ray meets a lattice."""
        coloured = (picture < 1 - 1 / 512).any(-1)
        origins, directions = self.rays[view]
        low, high = (torch.tensor(corner).to(origins) for corner in (lattice.origin, lattice.far))
        one, other = (low - origins) / directions, (high - origins) / directions
        first, last = torch.minimum(one, other).amax(1), torch.maximum(one, other).amin(1)
        return (coloured | (last > first.clamp(min=0))).nonzero()[:, 0]

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
        """Squared error of a frame over all its pixels, for the body's particles at x (N, 3): PAC-NeRF's loss.

        From at most ``pixels`` of those that show the body, drawn at random; the others are white in both. Divided by
        the number of ``frames`` whose mean it is a part of. Differentiable with respect to x; the gradient is taken as
        the picture is rendered, and for one piece of it at a time (`rendering.POINTS_AT_ONCE`), so that memory does not
        depend on its size.
        """
        lattice, values = body.shown.seen(x)
        picture = self.picture(k, view)
        chosen = self.shows_body(picture, view, lattice)
        count = len(chosen)
        if pixels is not None and count > pixels:
            drawn = torch.randperm(count, generator=generator)[:pixels]
            chosen = chosen[drawn.to(chosen.device)]
        rays, seen = [part[chosen] for part in self.rays[view]], picture[chosen]

        def terms(values):
            for part, colours, _ in body.field.render_in_pieces(lattice, values, *rays):
                squares = (colours - seen[part]).square().sum()
                yield squares * (count / max(1, len(chosen)) / len(picture)) / frames

        return sum_of_terms(terms, values)


@dataclass
class PacNerfHistory:
    """Curves of a fit, one entry an Adam step: the state before it.

    Attributes:
        loss: of the frames, views and pixels of the step.
        constants: what is fitted, by name.
        halvings: of the time step.
        seconds: wall time [s].
    """

    loss: list[float] = field(default_factory=list)
    constants: dict[str, list[float]] = field(default_factory=dict)
    halvings: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


@dataclass
class PacNerfFit:
    """What was found.

    Attributes:
        velocity: of all particles [m/s], shape (3,).
        velocity_losses: of every evaluation of L-BFGS.
        constants: of the law.
        history: of the constants.
        particles: how many move, and how many are seen.
    """

    velocity: Tensor
    velocity_losses: list[float]
    constants: FamilyConstants
    history: PacNerfHistory
    particles: tuple[int, int]

    def summary(self) -> str:
        """One line for people."""
        v, h = self.velocity.tolist(), self.history
        curves = ", ".join(
            f"{name} {curve[0]:.4g} -> {float(self.constants.values()[name].detach()):.4g}"
            for name, curve in h.constants.items()
        )
        return (
            f"v0 = ({v[0]:+.3f}, {v[1]:+.3f}, {v[2]:+.3f}) m/s in {len(self.velocity_losses)} evaluations; {curves} in"
            f" {len(h.loss)} steps; {self.particles[0]} of {self.particles[1]} particles move"
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
    """Find the velocity and the constants with which a body's pictures match a video.

    Args:
        model: grid, time step, gravity and walls.
        body: field and particles; their precision is that of the fit.
        observation: the video, in all views that are to be used.
        contact: step of the last frame before contact.
        constants: of the law, at the guess; fitted in place.
        settings: hyper-parameters.
        seed: of the views and pixels that are drawn.
        checkpoint: where the state is kept, so that a killed fit goes on.
        progress: called with (step, steps, loss).
        log: receives a line where something happens.

    Raises:
        InputError: no frame before contact, or none after it; a guess that no time step here is short enough for.
        NonFiniteError: a rollout runs away even in the shortest time step.
    """
    fit = _Fit(model, body, observation, contact, constants, settings, seed, log)
    if checkpoint is not None and (state := checkpoint.load()) is not None:
        fit.load_state_dict(state)
        log(f"resumed at step {fit.iteration} of {fit.iterations}")
    if fit.velocity is None:
        fit.find_velocity()
        if checkpoint is not None:
            checkpoint.save(fit.state_dict())
    while fit.iteration < fit.iterations:
        fit.step()
        if progress is not None:
            progress(fit.iteration, fit.iterations, fit.history.loss[-1])
        if checkpoint is not None and fit.iteration % settings.save_every == 0:
            checkpoint.save(fit.state_dict())
    counts = len(body.moving.x), len(body.shown.x)
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
                f"pac_nerf: {len(before)} frames before contact and {len(after)} after it: both are needed, the "
                "velocity is found in the former, the constants in the latter"
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
        """Whether the law is stable at the guess, in the shortest steps."""
        dt, rho = self.model.dt / 2**MOST_HALVINGS, float(self.body.state(torch.zeros(3)).density.min())
        number = replace(self.model, dt=dt).courant(self.constants.law(dt), rho)
        if not number <= COURANT_LIMIT:
            raise InputError(
                f"pac_nerf: the guess {self.constants.specification()} has Courant number {number:.3g}, above"
                f" {COURANT_LIMIT}, even in steps of {dt:g} s, the scene's halved {MOST_HALVINGS} times: give"
                " pac_nerf.families a softer one, or the scene a smaller dt"
            )

    def find_velocity(self) -> None:
        """One velocity for all particles, from rest, in all views of some frames before contact."""
        velocity = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        settings = self.settings
        optimizer = torch.optim.LBFGS(
            [velocity], lr=1, max_iter=settings.velocity_iterations, history_size=HISTORY, tolerance_grad=0,
            tolerance_change=LEAST_STEP, line_search_fn="strong_wolfe",
        )  # fmt: skip

        def evaluate():
            loss, _ = self._halving_steps(lambda halvings: self._velocity_loss(velocity, halvings))
            self.velocity_losses.append(loss)
            # torch has one bound for both
            scale = LEAST_STEP / LEAST_GAIN / max(self.velocity_losses[0], 1e-30)
            velocity.grad.mul_(scale)
            return torch.tensor(scale * loss, dtype=torch.float64)

        optimizer.step(evaluate)
        self.velocity = velocity.detach()
        self.log(f"v0 = {[round(v, 3) for v in self.velocity.tolist()]} m/s from {len(self.flying)} frames")

    def step(self) -> None:
        """One Adam step on the constants, with one random view for each frame."""
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
            # far from the modulus, Poisson's ratio only makes up for it, and has a long way back
            waits = group["name"] == "nu" and self.iteration < settings.iterations_contact
            group["lr"] = 0.0 if waits else decay * group["first_lr"]
        self.optimizer.step()
        self.history.loss.append(loss)
        self.history.halvings.append(halvings)
        self.history.seconds.append(time.perf_counter() - started)
        self.iteration += 1

    def _halving_steps(self, evaluate: Callable[[int], float]) -> tuple[float, int]:
        """A loss with its gradient, in time steps halved as often as it takes to be finite; and how often that is."""
        for halvings in range(MOST_HALVINGS + 1):
            try:
                return evaluate(halvings), halvings
            except NonFiniteError as error:
                last = error
        raise NonFiniteError(
            "pac_nerf",
            f"{last}, even in steps of {self.model.dt / 2**MOST_HALVINGS:g} s; lower pac_nerf.rate_modulus or choose "
            "another guess",
        )

    def _velocity_loss(self, velocity: Tensor, halvings: int) -> float:
        """Mean loss of the frames before contact in all views, with its gradient in the velocity."""
        velocity.grad = None
        moved, loss = self._moved(velocity, self.flying, halvings), 0.0
        seen = moved.detach().requires_grad_()
        for t, k in enumerate(self.flying):  # a piece of a picture at a time is in memory
            for view in range(len(self.video.rays)):
                error = self.video.error(self.body, seen[t], k, view, None, None, len(self.flying))
                error.backward()
                loss += float(error.detach())
        moved.backward(seen.grad)
        return self._finite(loss, [velocity])

    def _moved(self, velocity: Tensor, chosen: Sequence[int], halvings: int) -> Tensor:
        """Positions of what is seen at the chosen frames, (T, N, 3), in time steps halved so often."""
        model = replace(self.model, dt=self.model.dt / 2**halvings)
        frames = [self.video.frames[k] * 2**halvings for k in chosen]
        state = self.body.state(velocity)
        law = self.constants.law(model.dt, state.x.device)
        if (number := model.courant(law, float(state.density.min()))) > COURANT_LIMIT:
            raise NonFiniteError(
                "pac_nerf", f"Courant number {number:.2g} of {self.constants.specification()}"
            )
        return self.body.positions(rollout(model, law, state, steps=frames[-1], frames=frames).x)

    def _loss(self, chosen: Sequence[int], halvings: int) -> float:
        """Mean loss of the frames, each in a random view, with its gradient in the constants."""
        self.optimizer.zero_grad()
        moved, loss = self._moved(self.velocity, chosen, halvings), 0.0
        if not moved.requires_grad:
            raise InputError(
                f"pac_nerf: thrown at {self.velocity.tolist()} m/s the body touches nothing in the video, which says"
                " nothing of its law then: look at the field, or leave this method out"
            )
        seen = moved.detach().requires_grad_()
        for t, k in enumerate(chosen):
            view = int(torch.randint(len(self.video.rays), (), generator=self.generator))
            pixels = self.settings.pixels
            error = self.video.error(self.body, seen[t], k, view, pixels, self.generator, len(chosen))
            error.backward()
            loss += float(error.detach())
        moved.backward(seen.grad)
        return self._finite(loss, self.constants.parameters())

    def _finite(self, loss: float, of: Iterable[Tensor]) -> float:
        if not (math.isfinite(loss) and all(bool(p.grad.isfinite().all()) for p in of)):
            raise NonFiniteError(
                "pac_nerf", f"the loss or its gradient is not finite at step {self.iteration}"
            )
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


def spread(items: Sequence[int], most: int) -> list[int]:
    """At most so many of the items, evenly spread, the last one among them."""
    if len(items) <= most:
        return list(items)
    return [items[round((i + 1) * len(items) / most) - 1] for i in range(most)]
