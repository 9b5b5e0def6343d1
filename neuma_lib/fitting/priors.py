"""Priors: neural constitutive laws trained on published analytic ones (the paper's M_0, NCLaw).

Two ways lead from an analytic law to a pair of networks:

- ``regression`` (default): the law is known, so its stress and return map are regressed directly, on
  deformation gradients that cubes thrown about a box visit. One further round adds those that rollouts of
  the networks visit. Seconds a prior.
- ``trajectory``: NCLaw's training (Ma et al. 2023): one thrown cube, only its particles' positions are seen,
  and the gradient goes through the simulator. Many minutes a prior.

Either way the result is judged by its rollout against the law's, on throws that training has not seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

from neuma_lib.config.priors import RegressionConfig, TrajectoryConfig
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting.soap import SOAP
from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.elasticity import STRETCH_MIN
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.neural import LAYER_KEYS, PLASTIC_SCALE, SHAPES, NeuralLaw, features, neural_law
from neuma_lib.mechanics.singular_values import svd3
from neuma_lib.sim.model import MPMModel
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State

DENSITY = 1000.0
"""Density of every training cube [kg/m^3]."""

Progress = Callable[[int, int, float | None], None]


def train_prior(
    spec: Mapping[str, Any],
    settings: RegressionConfig | TrajectoryConfig,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[NeuralLaw, dict[str, Any]]:
    """Train a neural law on an analytic one.

    Args:
        spec: the analytic law, see :func:`neuma_lib.mechanics.analytic.analytic_law`.
        settings: of one of the two ways, which chooses the way.
        seed: of throws, noise, initial weights and batches.
        progress: called with (iterations done, iterations in all, loss).

    Returns:
        the law, and a report of plain numbers: losses, and how its rollout differs from its law's on unseen
        throws, see :func:`judge`.

    Raises:
        InputError: unknown material.
        NonFiniteError: training or a rollout diverged.
    """
    regression = isinstance(settings, RegressionConfig)
    train = train_by_regression if regression else train_by_trajectory
    law, report = train(spec, settings, seed, progress or (lambda done, total, loss: None))
    report["method"] = "regression" if regression else "trajectory"
    how = settings if regression else RegressionConfig(grid=settings.grid, dt=settings.dt)
    report.update(judge(law, spec, how, seed))
    return law, report


# ---------------------------------------------------------------------------------------------------- throws


@dataclass(frozen=True)
class Throw:
    """A cube of particles and its initial motion."""

    model: MPMModel
    state: State
    steps: int

    def run(self, law: Law, frames: list[int]):
        return rollout(self.model, law, self.state, steps=self.steps, frames=frames)


def reference_law(spec: Mapping[str, Any], settings: RegressionConfig) -> Law:
    """The analytic law, which knows the longest time step that suits it if it depends on the rate."""
    law = analytic_law(spec, dt=settings.dt)
    return analytic_law(spec, dt=longest_step(law, settings))


def longest_step(law: Law, settings: RegressionConfig) -> float:
    return min(settings.dt, 0.5 / (settings.grid * law.wave_speed(DENSITY)))


def random_throw(law: Law, generator: torch.Generator, settings: RegressionConfig) -> Throw:
    """A cube of random size, place, orientation, velocity and spin.

    Half of the throws take half the time step, so that the trial states of both are seen; not if the law
    depends on the rate, because a network knows one step only.
    """

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator)

    side = float(uniform(0.15, 0.35))
    rotation = random_rotations(1, generator)[0]
    reach = 0.5 * side * math.sqrt(3) + 0.1
    ticks = (torch.arange(settings.side_particles) + 0.5) / settings.side_particles - 0.5
    local = side * torch.cartesian_prod(ticks, ticks, ticks) @ rotation.mT
    centre = reach + (1 - 2 * reach) * uniform(0.0, 1.0, 3)
    centre[1] = reach + 0.3 * (1 - 2 * reach) * float(uniform(0.0, 1.0))
    v = torch.cat([uniform(-2.0, 2.0, 1), uniform(-4.0, -0.5, 1), uniform(-2.0, 2.0, 1)])
    omega = uniform(-6.0, 6.0, 3)
    halved = float(uniform(0.0, 1.0)) < 0.5 and "dt" not in getattr(law.plasticity, "constants", {})
    dt = longest_step(law, settings) * (0.5 if halved else 1.0)
    count = len(local)
    state = State(
        centre + local,
        v + torch.linalg.cross(omega.expand_as(local), local),
        torch.full((count,), DENSITY * side**3 / count),
        torch.full((count,), side**3 / count),
    )
    return Throw(MPMModel(grid=settings.grid, dt=dt), state, math.ceil(settings.duration / dt))


def random_rotations(count: int, generator: torch.Generator) -> Tensor:
    """Uniformly distributed rotations (count, 3, 3)."""
    q = torch.randn(count, 4, generator=generator)
    w, x, y, z = (q / q.norm(dim=1, keepdim=True)).unbind(1)
    return torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        dim=1,
    ).reshape(-1, 3, 3)


def visited_stretches(throw: Throw, law: Law, every: int = 8) -> tuple[Tensor, Tensor]:
    """Principal stretches of F and of F_trial that a rollout meets, (M, 3) each.

    F_trial = (I + dt C) F of the step before, from pairs of consecutive frames.
    """
    firsts = list(range(0, throw.steps - 1, every))
    frames = sorted({n for first in firsts for n in (first, first + 1)})
    path = throw.run(law, frames)
    before = [frames.index(n) for n in firsts]
    after = [frames.index(n + 1) for n in firsts]
    eye = torch.eye(3)
    trial = (eye + throw.model.dt * path.C[after]) @ path.F[before]
    return svd3(path.F.reshape(-1, 3, 3))[1], svd3(trial.reshape(-1, 3, 3))[1]


# ------------------------------------------------------------------------------------------------ regression


def train_by_regression(
    spec: Mapping[str, Any], settings: RegressionConfig, seed: int, progress: Progress
) -> tuple[NeuralLaw, dict[str, Any]]:
    generator = torch.Generator().manual_seed(seed)
    reference = reference_law(spec, settings)
    throws = [random_throw(reference, generator, settings) for _ in range(settings.throws)]
    pools = [visited_stretches(throw, reference) for throw in throws]
    elastic, plastic = (torch.cat(parts) for parts in zip(*pools, strict=True))

    total = 2 * settings.rounds * settings.iterations
    done = 0
    networks: dict[str, Network] = {}
    losses: dict[str, list[float]] = {"elasticity": [], "plasticity": []}
    for index in range(settings.rounds):
        if index:
            law = _law_of(networks)
            for throw in throws:
                try:
                    more = visited_stretches(throw, law)
                except NonFiniteError:
                    continue  # a first round that is unstable in one throw is what the next round mends
                elastic, plastic = torch.cat([elastic, more[0]]), torch.cat([plastic, more[1]])
        for part, pool in (("elasticity", elastic), ("plasticity", plastic)):
            F = sample_deformations(pool, settings, generator)
            z, X = targets(reference, part, F)
            network = networks.get(part) or Network(z, X, generator)

            def shown(iteration: int, loss: float, before: int = done) -> None:
                progress(before + iteration, total, loss)

            losses[part].append(network.fit(z, X, settings, generator, shown))
            networks[part] = network
            done += settings.iterations
    law = _law_of(networks)
    report = {"loss": losses, "pairs": settings.samples}
    report.update(plastic_errors(law, reference, plastic, generator))
    return law, report


def plastic_errors(
    law: Law, reference: Law, pool: Tensor, generator: torch.Generator, count: int = 20000
) -> dict[str, float]:
    """Errors of a step's plastic correction F - F_trial on visited stretches (M, 3).

    Returns:
        ``elastic_error``: mean norm of the correction where the law makes none; ``yield_error``: mean norm of the
        error over the mean norm of the correction where it makes one. Zero where there are no such states.
    """
    sigma = pool[torch.randint(len(pool), (count,), generator=generator)]
    F = sigma[:, :, None] * random_rotations(count, generator)
    true = reference.plasticity.evaluate(F, ()) - F
    error = (law.plasticity.evaluate(F, law.plasticity.weights()) - F - true).norm(dim=(1, 2))
    yields = true.norm(dim=(1, 2)) > 0
    errors = {"elastic_error": 0.0, "yield_error": 0.0}
    if bool((~yields).any()):
        errors["elastic_error"] = float(error[~yields].mean())
    if bool(yields.any()):
        errors["yield_error"] = float(error[yields].mean() / true[yields].norm(dim=(1, 2)).mean())
    return errors


def sample_deformations(pool: Tensor, settings: RegressionConfig, generator: torch.Generator) -> Tensor:
    """Deformation gradients diag(sigma) V^T around visited stretches, (samples, 3, 3).

    Half of the stretches, the first, are as visited; most others get random log strains added, a tenth of all
    are such strains alone. V is a random rotation; one from the left changes neither features nor targets.
    """
    n = settings.samples
    picked = pool[torch.randint(len(pool), (n,), generator=generator)]
    rank = torch.arange(n) / n
    strain = picked.clamp(min=STRETCH_MIN).log() * (rank < 0.9)[:, None]
    low, high = math.log(settings.noise_low), math.log(settings.noise_high)
    size = torch.exp(low + (high - low) * torch.rand(n, 1, generator=generator))
    strain = strain + size * torch.randn(n, 3, generator=generator) * (rank >= 0.5)[:, None]
    sigma = strain.clamp(-2.0, 1.5).exp().sort(dim=1, descending=True).values
    return sigma[:, :, None] * random_rotations(n, generator)


def targets(law: Law, part: str, F: Tensor) -> tuple[Tensor, Tensor]:
    """Features (n, 13) of F, and the symmetric X (n, 9) that the network has to give for the law's answer."""
    U, sigma, Vh = svd3(F.double())
    R = U @ Vh
    if part == "elasticity":
        tau = law.elasticity.evaluate(F.double(), ())
        X = R.mT @ tau @ torch.linalg.inv(F.double()).mT
    else:
        X = R.mT @ (law.plasticity.evaluate(F.double(), ()) - F.double()) / PLASTIC_SCALE
    X = 0.5 * (X + X.mT)
    return features(F.double(), sigma).float(), X.reshape(-1, 9).float()


class Network:
    """A network in normalised units while it is fitted; :meth:`weights` folds the units back in."""

    def __init__(self, z: Tensor, X: Tensor, generator: torch.Generator):
        visited = slice(len(z) // 2)
        self.unit_in = float(z[visited].square().mean(1).sqrt().median())
        size = X[visited].norm(dim=1)
        self.unit_out = float(size[size > 0].median()) if bool((size > 0).any()) else 1.0
        bounds = [(6 / sum(shape)) ** 0.5 for shape in SHAPES]
        self.layers = [
            ((2 * torch.rand(shape, generator=generator) - 1) * bound).requires_grad_()
            for shape, bound in zip(SHAPES, bounds, strict=True)
        ]

    def fit(
        self,
        z: Tensor,
        X: Tensor,
        settings: RegressionConfig,
        generator: torch.Generator,
        progress: Callable[[int, float], None],
    ) -> float:
        """Minimise the relative squared error; returns the mean loss of the last tenth of the iterations."""
        if not bool(X.any()):
            with torch.no_grad():
                self.layers[2].zero_()  # nothing to learn, and zero is exact
            progress(settings.iterations, 0.0)
            return 0.0
        z, X = z / self.unit_in, X / self.unit_out
        weight = 1 / (X.square().sum(1) + settings.floor**2)
        optimiser = SOAP(self.layers, settings.learning_rate)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, settings.learning_rate, settings.iterations, pct_start=0.05, cycle_momentum=False
        )
        tail, last = 0.0, max(settings.iterations // 10, 1)
        for iteration in range(settings.iterations):
            rows = torch.randint(len(z), (settings.batch,), generator=generator)
            W0, W1, W2 = self.layers
            Y = (gelu(gelu(z[rows] @ W0.mT) @ W1.mT) @ W2.mT).view(-1, 3, 3)
            error = (0.5 * (Y + Y.mT)).view(-1, 9) - X[rows]
            loss = (error.square().sum(1) * weight[rows]).mean()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(self.layers, 1.0)
            optimiser.step()
            schedule.step()
            if iteration % 50 == 0 or iteration >= settings.iterations - last:
                value = float(loss.detach())
                if not math.isfinite(value):
                    raise NonFiniteError(
                        "prior", f"regression diverged at iteration {iteration}; lower learning_rate"
                    )
                progress(iteration + 1, value)
                tail += value * (iteration >= settings.iterations - last)
        return tail / last

    def weights(self) -> tuple[Tensor, ...]:
        W0, W1, W2 = (w.detach() for w in self.layers)
        return W0 / self.unit_in, W1, W2 * self.unit_out


def _law_of(networks: Mapping[str, Network]) -> NeuralLaw:
    return neural_law(
        {
            f"{part}.{key}": weight
            for part, network in networks.items()
            for key, weight in zip(LAYER_KEYS, network.weights(), strict=True)
        }
    )


# ------------------------------------------------------------------------------------------------ trajectory


def train_by_trajectory(
    spec: Mapping[str, Any], settings: TrajectoryConfig, seed: int, progress: Progress
) -> tuple[NeuralLaw, dict[str, Any]]:
    throw = _nclaw_throw(settings)
    truth = throw.run(analytic_law(spec, dt=settings.dt), list(range(settings.steps + 1)))
    law = neural_law(seed=seed)
    groups = {
        "elasticity": (list(law.elasticity.base), settings.learning_rate_elastic),
        "plasticity": (list(law.plasticity.base), settings.learning_rate_plastic),
    }
    for parameters, _ in groups.values():
        for parameter in parameters:
            parameter.requires_grad_()
    optimiser = torch.optim.Adam([{"params": p, "lr": rate} for p, rate in groups.values()])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs)
    history = []
    for epoch in range(settings.epochs):
        share = epoch / max(settings.epochs - 1, 1)
        length = round(settings.reset_first + share * (settings.reset_last - settings.reset_first))
        optimiser.zero_grad(set_to_none=True)
        total = 0.0
        for first in range(0, settings.steps, length):
            count = min(length, settings.steps - first)
            start = {name: getattr(truth, name)[first] for name in ("x", "v", "F", "C")}
            path = rollout(
                throw.model,
                law,
                replace(throw.state, **start),
                steps=count,
                frames=range(1, count + 1),
                skip_free_flight=False,
            )
            loss = (path.x - truth.x[first + 1 : first + count + 1]).square().mean(dim=(1, 2)).sum()
            loss.backward()
            total += float(loss.detach())
        for parameters, _ in groups.values():
            nn.utils.clip_grad_norm_(parameters, settings.gradient_clip)
        optimiser.step()
        schedule.step()
        history.append(total / settings.steps)
        progress(epoch + 1, settings.epochs, history[-1])
    for parameters, _ in groups.values():
        for parameter in parameters:
            parameter.requires_grad_(False)
    return law, {"loss": history}


def _nclaw_throw(settings: TrajectoryConfig) -> Throw:
    """NCLaw's training throw: a cube of side 0.5 m in the middle of a slippery box."""
    side, n = 0.5, settings.side_particles
    ticks = side * ((torch.arange(n) + 0.5) / n - 0.5)
    local = torch.cartesian_prod(ticks, ticks, ticks)
    omega = torch.full((3,), 4.0)
    v = torch.tensor([1.0, -1.5, -2.0]) + torch.linalg.cross(omega.expand_as(local), local)
    model = MPMModel(grid=settings.grid, dt=settings.dt, boundary="slip", wall_cells=3)
    mass = torch.full((len(local),), DENSITY * side**3 / len(local))
    return Throw(model, State(0.5 + local, v, mass, mass / DENSITY), settings.steps)


# ---------------------------------------------------------------------------------------------------- judging


def judge(
    law: Law,
    spec: Mapping[str, Any],
    settings: RegressionConfig,
    seed: int = 0,
    throws: int = 3,
    frames: int = 20,
) -> dict[str, float]:
    """How far a law's rollouts are from those of the analytic law, on throws of their own.

    Returns:
        ``chamfer`` (mean squared nearest-neighbour distance, both directions summed [1e-4 m^2]) and ``rmse``
        of corresponding particles [m], means over frames and throws; ``rmse_worst``, the worst frame's [m].
    """
    generator = torch.Generator().manual_seed(10_000 + seed)
    chamfers, errors = [], []
    reference = reference_law(spec, settings)
    for _ in range(throws):
        throw = random_throw(reference, generator, settings)
        steps = [round(i * throw.steps / frames) for i in range(1, frames + 1)]
        try:
            with torch.no_grad():
                seen, truth = throw.run(law, steps), throw.run(reference, steps)
        except NonFiniteError as error:
            raise NonFiniteError(
                "prior", f"the trained law is unstable ({error.detail}); train it longer"
            ) from error
        errors.append((seen.x - truth.x).square().sum(-1).mean(-1).sqrt())
        chamfers.append(float(chamfer_sequence(seen.x, truth.x).mean()))
    rmse = torch.stack(errors)
    return {
        "chamfer": sum(chamfers) / throws,
        "rmse": float(rmse.mean()),
        "rmse_worst": float(rmse.max()),
    }
