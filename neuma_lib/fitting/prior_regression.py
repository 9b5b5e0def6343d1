"""Priors by regression: networks fitted to the stress and the return map of a known law.

The pairs (F -> tau) and (F_trial -> F) lie at deformation gradients that thrown cubes visit. From the second round on
those that rollouts of the networks visit are added.

Outside these pairs a network is left to chance. Where it takes volume from an element in every step, and answers with
tension, the element collapses for good: seen in water, whose pressure falls again below J = 1/2. So the networks are
tried on throws that are harder than those of the training, and if they crush an element that their law does not, a
longer round follows with the states of these throws added. A prior that passes is not changed by the trial.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

from neuma_lib.config.priors import RegressionConfig
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting.prior_throws import (
    Progress,
    Throw,
    random_rotations,
    random_throw,
    reference_law,
    visited_stretches,
)
from neuma_lib.fitting.soap import SOAP
from neuma_lib.mechanics.elasticity import STRETCH_MIN
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.neural import LAYER_KEYS, PLASTIC_SCALE, SHAPES, NeuralLaw, features, neural_law
from neuma_lib.mechanics.singular_values import svd3

_AS_VISITED = 0.5
"""Part of the training stretches that rollouts visited; the units of a network are measured on it."""
_PURE_NOISE = 0.1
"""Part of the training stretches that are random alone, so that nothing far from a rollout is left to chance."""
_LOG_STRETCHES = (-2.0, 1.5)
"""Range of the logarithms of the training stretches: 0.14 to 4.5."""
_TRIAL_SEEDS = 30_000
"""Added to a prior's seed: throws on which the networks are tried are not those of the training or of the judgement."""
_TRIAL_SPEED = 1.25
"""Speed of the trial throws over that of the others, so that an unseen throw does not go beyond the data."""
_LONGER = 3
"""Iterations of a further round over those of the others: its data are more various."""
_WARM_UP = 0.05
"""Part of the iterations over which the learning rate rises."""
_GRADIENT_CLIP = 1.0
"""Largest gradient norm of a network in normalised units."""
_LAST_PART = 10
"""The reported loss is the mean of the last 1 / this of the iterations."""
_REPORT_EVERY = 50
"""Iterations from one report of the progress to the next."""


def train_by_regression(
    spec: Mapping[str, Any], settings: RegressionConfig, seed: int, progress: Progress
) -> tuple[NeuralLaw, dict[str, Any]]:
    generator = torch.Generator().manual_seed(seed)
    reference = reference_law(spec, settings)
    throws = [random_throw(reference, generator, settings) for _ in range(settings.throws)]
    pools = [visited_stretches(throw, reference) for throw in throws]
    elastic, plastic = (torch.cat(parts) for parts in zip(*pools, strict=True))

    trials = torch.Generator().manual_seed(_TRIAL_SEEDS + seed)
    total, done = 2 * settings.rounds * settings.iterations, 0
    networks: dict[str, Network] = {}
    losses: dict[str, list[float]] = {"elasticity": [], "plasticity": []}
    how = settings
    for index in range(settings.rounds + settings.further_rounds):
        if index:
            law = _law_of(networks)
            if index < settings.rounds:
                more = [states for throw in throws if (states := _visited(throw, law))]
            else:
                more = missing_states(law, reference, trials, settings)
                if not more:
                    break
                how = settings.model_copy(update={"iterations": _LONGER * settings.iterations})
                total += 2 * how.iterations
            elastic, plastic = (
                torch.cat([pool, *parts]) for pool, *parts in zip((elastic, plastic), *more, strict=True)
            )
        for part, pool in (("elasticity", elastic), ("plasticity", plastic)):
            F = sample_deformations(pool, settings, generator)
            z, X = targets(reference, part, F)
            network = networks.get(part) or Network(z, X, generator)

            def shown(iteration: int, loss: float, before: int = done, total: int = total) -> None:
                progress(before + iteration, total, loss)

            losses[part].append(network.fit(z, X, how, generator, shown))
            networks[part] = network
            done += how.iterations
    law = _law_of(networks)
    report = {"loss": losses, "pairs": settings.samples}
    report.update(plastic_errors(law, reference, plastic, generator))
    return law, report


def _visited(throw: Throw, law: Law) -> tuple[Tensor, Tensor] | None:
    """`visited_stretches`; None if the law is unstable, which is what the next round mends."""
    try:
        return visited_stretches(throw, law)
    except NonFiniteError:
        return None


def missing_states(
    law: Law, reference: Law, generator: torch.Generator, settings: RegressionConfig
) -> list[tuple[Tensor, Tensor]]:
    """States that the data of the networks ``law`` lack, if on faster throws these crush what their law does not.

    Returns:
        none if every throw in which ``law`` crushes an element is one in which ``reference`` does, too. Else the
        principal stretches of F and of F_trial, (M, 3) each, that either law visits in each throw; without the crushed
        states of ``law``, where its reference does not go.
    """
    throws = [random_throw(reference, generator, settings, _TRIAL_SPEED) for _ in range(settings.throws)]
    tried = [_visited(throw, law) for throw in throws]
    suspects = [index for index, states in enumerate(tried) if _crushes(states)]
    if not suspects:
        return []
    true = [_visited(throw, reference) for throw in throws]
    if all(_crushes(true[index]) for index in suspects):
        return []
    kept = [tuple(part[~_crushed(part)] for part in states) for states in tried if states]
    return [states for states in true if states] + kept


def _crushes(states: tuple[Tensor, Tensor] | None) -> bool:
    """Whether a rollout crushed an element, or broke off, from what `_visited` returned."""
    return states is None or bool(_crushed(states[0]).any())


def _crushed(stretches: Tensor) -> Tensor:
    """Which of the states (M, 3) are pressed together so far that laws know them no more, or turned inside out."""
    return stretches.amin(1) < STRETCH_MIN


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

    The first `_AS_VISITED` of them are as visited, the others get random log strains added, the last `_PURE_NOISE` are
    such strains alone. V is a random rotation; one from the left changes neither features nor targets.
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
