"""The nearest law of another engine to any law, over the states that it has visited."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize, nnls
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.evaluation.material_point import returned, stress
from neuma_lib.export.materials import RULES, check_engine, engine_material
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law

MAX_ERROR = 0.1  # largest relative stress error of a fit that is accepted without force
MAX_STATES = 1000  # approximate number of the visited states that are compared
INCREMENT = 0.1  # strain of a trial state, relative to the visited strains
_STARTS: dict[str, dict[str, Sequence[float]]] = {
    "identity": {},
    "fluid_projection": {},
    "von_mises": {"yield_stress": (0.03, 0.1, 0.3, 1.0)},
    "viscous_flow": {"viscosity": (0.1, 1.0, 10.0), "yield_stress": (1e-3, 0.3)},
    "drucker_prager": {"friction_angle": (10.0, 25.0, 45.0)},
}
"""Initial constants of the return maps that are fitted: stresses relative to the largest visited deviator, viscosities
to that stress over a rate of one visited strain in 100 steps."""


@dataclass(frozen=True)
class Fit:
    """A law that an engine has, fitted to another law."""

    spec: dict[str, Any]  # its specification
    # root mean square of the stress error over that of the stress, in the visited elastic states (``stress``)
    # and after the return map of trial states (``returned``)
    errors: dict[str, float]

    @property
    def error(self) -> float:
        return max(self.errors.values())


def nearest(law: Law, states: Tensor, engine: str, dt: float) -> Fit:
    """Fit every family of an engine by least squares and select the one with the smallest error.

    The stresses of all families are linear in both Lamé parameters. Constants of return maps are fitted to the stress
    after the return of trial states, which are visited states with random increments of strain (`INCREMENT`).

    Args:
        states: elastic deformation gradients that it has visited, (N, 3, 3).
        engine: one of `neuma_lib.export.materials.ENGINES`.
        dt: time step [s].

    Raises:
        InputError: no visited state has a stress.
    """
    check_engine(engine)
    F = states.double().reshape(-1, 3, 3)
    F = F[:: max(1, len(F) // MAX_STATES)]
    tau = stress(law, F)
    if not bool(tau.isfinite().all()) or not bool(tau.abs().max() > 0):
        problem = "the law has no finite stress in the visited states"
        raise InputError("states", problem, "Give the states of a motion")
    trial = trial_states(F)
    after = stress(law, returned(law, trial))
    fits = [_fit(engine, names, F, tau, trial, after, dt) for names in RULES[engine]]
    able = [fit for fit in fits if fit is not None and _has(engine, fit.spec, dt)]
    enough = min(fit.error for fit in able) + 0.01  # a simpler law is preferred to 1 % of the stress
    return min(
        (fit for fit in able if fit.error <= enough), key=lambda fit: (len(fit.spec["plasticity"]), fit.error)
    )


def trial_states(F: Tensor) -> Tensor:
    """States F (N, 3, 3) after random increments of strain."""
    generator = torch.Generator().manual_seed(0)
    strain = torch.linalg.svdvals(F).log().square().mean().sqrt()
    increment = torch.randn(F.shape, generator=generator, dtype=F.dtype)
    return torch.linalg.matrix_exp(INCREMENT * strain * (increment + increment.mT)) @ F


def sampled_states(visited: Mapping[str, Any]) -> Tensor:
    """Elastic deformation gradients (2000, 3, 3) within recorded ranges (`Visited`), with random directions."""
    rng, count = np.random.default_rng(0), 2000
    low, high = np.log(visited["stretch"])
    shear = 0.5 * float(visited["shear"][1])
    widest = 2 * math.asinh(shear)  # of the logarithms of two stretches whose simple shear has this amount
    logs = rng.uniform(low, high, (64 * count, 3))
    inside = (np.ptp(logs, axis=1) <= widest) & (logs.sum(axis=1) >= math.log(visited["pressed"]))
    if inside.sum() < count:
        problem = "the recorded ranges contain too few states"
        raise InputError("visited", problem, "Export the law again from its scene")
    U, V = (np.linalg.qr(rng.standard_normal((count, 3, 3)))[0] for _ in range(2))
    for Q in (U, V):
        Q[:, :, 0] *= np.linalg.det(Q)[:, None]
    return torch.from_numpy((U * np.exp(logs[inside][:count])[:, None]) @ V.transpose(0, 2, 1))


def _fit(engine: str, names, F: Tensor, tau: Tensor, trial: Tensor, after: Tensor, dt: float) -> Fit | None:
    """Fit one family, or None if it is not fitted."""
    elastic, plastic = names
    if plastic not in _STARTS:
        return None
    # mu = 1, lam = 0 and 1
    unit, other = ({"name": elastic, "E": 2 * (1 + nu), "nu": nu} for nu in (0.0, 0.25))
    of_mu, both = (stress(analytic_law({"elasticity": each}), F) for each in (unit, other))
    columns = np.stack([of_mu.reshape(-1).numpy(), (both - of_mu).reshape(-1).numpy()], axis=1)
    (mu, lam), _ = nnls(columns, tau.reshape(-1).numpy())
    if elastic == "fluid":
        mu = 1e-3 * lam  # its stress does not depend on mu
    if mu <= 1e-6 * lam or lam + mu <= 0:  # no such solid
        return None
    moduli = {"E": mu * (3 * lam + 2 * mu) / (lam + mu), "nu": lam / (2 * (lam + mu))}
    base = {"elasticity": {"name": elastic, **moduli}}
    largest = float(
        (tau - tau.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(3)).norm(dim=(1, 2)).max()
    )
    scales = {"yield_stress": largest, "viscosity": 100 * largest / (2 * mu) * mu * dt, "friction_angle": 1.0}
    starts = {
        key: [max(value * scales[key], 1e-9) for value in values] for key, values in _STARTS[plastic].items()
    }
    if (engine, plastic) == ("genesis", "viscous_flow"):
        starts.pop("yield_stress")

    def spec(logs) -> dict[str, Any]:
        constants = dict(zip(starts, np.exp(logs).tolist(), strict=True))
        if "friction_angle" in constants:
            constants["friction_angle"] = min(constants["friction_angle"], 89.0)
        return {**base, "plasticity": {"name": plastic, **constants}}

    def error(logs) -> float:
        own = analytic_law(spec(logs), dt)
        return _relative(stress(own, returned(own, trial)), after)

    best: Sequence[float] = ()
    if starts:
        grid = np.stack(np.meshgrid(*(np.log(each) for each in starts.values()), indexing="ij"), axis=-1)
        start = min(grid.reshape(-1, len(starts)), key=error)
        best = minimize(error, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-5}).x
    own = analytic_law(spec(best), dt)
    return Fit(spec(best), {"stress": _relative(stress(own, F), tau), "returned": error(best)})


def _has(engine: str, spec: Mapping[str, Any], dt: float) -> bool:
    """Whether an engine has a law with these constants."""
    try:
        return bool(engine_material(spec, 1.0, dt, engine))
    except InputError:
        return False


def _relative(values: Tensor, true: Tensor) -> float:
    return float((values - true).norm() / true.norm())
