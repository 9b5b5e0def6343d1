"""Priors by regression: networks fitted to the stress and the return map of a known law.

The pairs (F -> tau) and (F_trial -> F) are at deformation gradients that simulated cubes visit. From the second round
on, those visited by rollouts of the networks are added.

A network is undetermined outside these pairs. If it removes volume from an element in every step and responds with
tension, the element collapses permanently, as observed for water, whose pressure decreases below J = 1/2. The networks
are therefore tested on faster motions than those of the training. If they crush an element that the law does not, a
longer round with the states of these motions follows. The test does not change priors that pass.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

from neuma_lib.config.priors import RegressionConfig
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting.prior_launches import (
    Launch,
    Progress,
    random_launch,
    random_rotations,
    reference_law,
    visited_stretches,
)
from neuma_lib.fitting.soap import SOAP
from neuma_lib.mechanics.adaptor import LAYER_KEYS
from neuma_lib.mechanics.elasticity import STRETCH_MIN
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.neural import PLASTIC_SCALE, SHAPES, NeuralLaw, features, neural_law
from neuma_lib.mechanics.singular_values import svd3

_AS_VISITED = 0.5
"""Share of the training stretches that rollouts visited, from which the units of a network are computed."""
_PURE_NOISE = 0.1
"""Share of the training stretches that are purely random, which covers states far from any rollout."""
_LOG_STRETCHES = (-2.0, 1.5)  # range of the logarithms of the training stretches, which are 0.14 to 4.5
_TEST_SEEDS = 30_000
"""Offset of the seed for tests, so that their motions differ from those of training and evaluation."""
_TEST_SPEED = 1.25  # speed factor of the motions in tests, so that unseen motions stay within the data
_LONGER = 3  # factor of the iterations in an additional round, whose data are more diverse
_WARM_UP = 0.05  # share of the iterations in which the learning rate rises
_GRADIENT_CLIP = 1.0  # largest gradient norm of a network in normalised units
_LAST_PART = 10  # the reported loss is the mean over the last 1 / `_LAST_PART` of the iterations
_REPORT_EVERY = 50  # iterations between progress reports


def train_by_regression(
    spec: Mapping[str, Any], settings: RegressionConfig, seed: int, progress: Progress
) -> tuple[NeuralLaw, dict[str, Any]]:
    """Fit a neural law to an analytic one, see :func:`neuma_lib.fitting.prior_training.train_prior`."""
    generator = torch.Generator().manual_seed(seed)
    reference = reference_law(spec, settings)
    launches = [random_launch(reference, generator, settings) for _ in range(settings.throws)]
    pools = [visited_stretches(launch, reference) for launch in launches]
    elastic, plastic = (torch.cat(parts) for parts in zip(*pools, strict=True))

    tests = torch.Generator().manual_seed(_TEST_SEEDS + seed)
    total, done = 2 * settings.rounds * settings.iterations, 0
    networks: dict[str, Network] = {}
    losses: dict[str, list[float]] = {"elasticity": [], "plasticity": []}
    current = settings
    for index in range(settings.rounds + settings.further_rounds):
        if index:
            law = _law_of(networks)
            if index < settings.rounds:
                more = [states for launch in launches if (states := _visited(launch, law))]
            else:
                more = missing_states(law, reference, tests, settings)
                if not more:
                    break
                current = settings.model_copy(update={"iterations": _LONGER * settings.iterations})
                total += 2 * current.iterations
            elastic, plastic = (
                torch.cat([pool, *parts]) for pool, *parts in zip((elastic, plastic), *more, strict=True)
            )
        for part, pool in (("elasticity", elastic), ("plasticity", plastic)):
            F = sample_deformations(pool, settings, generator)
            z, X = targets(reference, part, F)
            network = networks.get(part) or Network(z, X, generator)

            def report_progress(iteration: int, loss: float, before: int = done, total: int = total) -> None:
                progress(before + iteration, total, loss)

            losses[part].append(network.fit(z, X, current, generator, report_progress))
            networks[part] = network
            done += current.iterations
    law = _law_of(networks)
    report = {"loss": losses, "pairs": settings.samples}
    report.update(plastic_errors(law, reference, plastic, generator))
    return law, report


def _visited(launch: Launch, law: Law) -> tuple[Tensor, Tensor] | None:
    """`visited_stretches`, or None if the law is unstable, which the next round corrects."""
    try:
        return visited_stretches(launch, law)
    except NonFiniteError:
        return None


def missing_states(
    law: Law, reference: Law, generator: torch.Generator, settings: RegressionConfig
) -> list[tuple[Tensor, Tensor]]:
    """States to add to the data if the networks ``law`` crush elements in faster motions and their law does not.

    Returns:
        Principal stretches of F and of F_trial, (M, 3) each, that either law visits in each motion, without crushed
        states of ``law``. Empty if ``reference`` crushes elements in every motion in which ``law`` does.
    """
    launches = [random_launch(reference, generator, settings, _TEST_SPEED) for _ in range(settings.throws)]
    tested = [_visited(launch, law) for launch in launches]
    suspects = [index for index, states in enumerate(tested) if _crushes(states)]
    if not suspects:
        return []
    true = [_visited(launch, reference) for launch in launches]
    if all(_crushes(true[index]) for index in suspects):
        return []
    kept = [tuple(part[~_crushed(part)] for part in states) for states in tested if states]
    return [states for states in true if states] + kept


def _crushes(states: tuple[Tensor, Tensor] | None) -> bool:
    """Whether a rollout diverged or crushed an element, from the result of `_visited`."""
    return states is None or bool(_crushed(states[0]).any())


def _crushed(stretches: Tensor) -> Tensor:
    """Mask of the states (M, 3) that are inverted or compressed below the range of the laws."""
    return stretches.amin(1) < STRETCH_MIN


def plastic_errors(law: Law, reference: Law, pool: Tensor, generator: torch.Generator) -> dict[str, float]:
    """Errors of the plastic correction F - F_trial of a step on visited stretches (M, 3).

    Returns:
        ``elastic_error``: mean norm of the correction at elastic states; ``yield_error``: mean norm of the error
        divided by the mean norm of the correction at yielding states. Zero if there are no such states.
    """
    count = 20000
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

    The first `_AS_VISITED` of them are visited stretches, random log strains are added to the others, and the last
    `_PURE_NOISE` are random only. V is a random rotation. Rotations from the left change neither features nor targets.
    """
    n = settings.samples
    picked = pool[torch.randint(len(pool), (n,), generator=generator)]
    rank = torch.arange(n) / n
    strain = picked.clamp(min=STRETCH_MIN).log() * (rank < 1 - _PURE_NOISE)[:, None]
    low, high = math.log(settings.noise_low), math.log(settings.noise_high)
    size = torch.exp(low + (high - low) * torch.rand(n, 1, generator=generator))
    strain = strain + size * torch.randn(n, 3, generator=generator) * (rank >= _AS_VISITED)[:, None]
    sigma = strain.clamp(*_LOG_STRETCHES).exp().sort(dim=1, descending=True).values
    return sigma[:, :, None] * random_rotations(n, generator)


def targets(law: Law, part: str, F: Tensor) -> tuple[Tensor, Tensor]:
    """Features (n, 13) of F, and the symmetric network output X (n, 9) that reproduces the law."""
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
    """A network in normalised units during the fit. :meth:`weights` includes the units."""

    def __init__(self, z: Tensor, X: Tensor, generator: torch.Generator):
        visited = slice(int(_AS_VISITED * len(z)))
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
        """Minimise the relative squared error, and return the mean loss of the last tenth of the iterations."""
        if not bool(X.any()):
            with torch.no_grad():
                self.layers[2].zero_()  # exact
            progress(settings.iterations, 0.0)
            return 0.0
        z, X = z / self.unit_in, X / self.unit_out
        weight = 1 / (X.square().sum(1) + settings.floor**2)
        optimiser = SOAP(self.layers, settings.learning_rate)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, settings.learning_rate, settings.iterations, pct_start=_WARM_UP, cycle_momentum=False
        )
        tail, last = 0.0, max(settings.iterations // _LAST_PART, 1)
        for iteration in range(settings.iterations):
            rows = torch.randint(len(z), (settings.batch,), generator=generator)
            W0, W1, W2 = self.layers
            Y = (gelu(gelu(z[rows] @ W0.mT) @ W1.mT) @ W2.mT).view(-1, 3, 3)
            error = (0.5 * (Y + Y.mT)).view(-1, 9) - X[rows]
            loss = (error.square().sum(1) * weight[rows]).mean()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(self.layers, _GRADIENT_CLIP)
            optimiser.step()
            schedule.step()
            if iteration % _REPORT_EVERY == 0 or iteration >= settings.iterations - last:
                value = float(loss.detach())
                if not math.isfinite(value):
                    problem = f"the regression diverged at iteration {iteration}. Lower learning_rate"
                    raise NonFiniteError("prior", problem)
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
