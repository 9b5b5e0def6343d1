"""Laws sampled from the uncertainty of identified constants.

An identified family has a covariance of its unbounded constants (`neuma_lib.fitting.families`). Laws are sampled from
that normal distribution, with the error that all images share (`identify.model_std`) added. Families that tie with the
best one get equal parts of the samples.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from neuma_lib.fitting.families import Family
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPM


def constants_draws(
    identified: Mapping[str, Any],
    model_std: float,
    dt: float,
    count: int,
    seed: int,
    *,
    of: str = "best",
    covariance: str = "covariance",
    stable_in: tuple[MPM, float] | None = None,
) -> list[Law]:
    """Sample laws of the family in an identified.json, and of those that tie with it.

    Args:
        identified: content of the file.
        model_std: standard deviation of every unbounded constant in addition to that from the images.
        dt: time step [s].
        count: approximate number of laws, divided equally among the families.
        of: its entry with the constants, "best" or "material".
        covariance: "covariance", or "laplace" for the Laplace approximation.
        stable_in: simulator and density [kg/m^3] that limit the stiffness, see `stable_law`.
    """
    generator = np.random.default_rng(seed)
    fits = [identified[of], *(identified["families"][name] for name in identified["ties"])]
    each, laws = -(-count // len(fits)), []
    for fit in fits:
        family = Family("drawn", fit["law"])
        spread = np.array(fit["unbounded"][covariance]) + model_std**2 * np.eye(len(family.constants))
        for u in generator.multivariate_normal(fit["unbounded"]["values"], spread, each):
            values = family.values(u, *stable_in) if stable_in else family.bounded(u)
            laws.append(analytic_law(family.law_spec(values), dt))
    return laws


def stable_law(fit: Mapping[str, Any], model: MPM, density: float) -> Law:
    """The law of a fit in an identified.json, at most as stiff as a fit on the grid of a simulator may be.

    Args:
        fit: its entry "best" or "material". The latter was extrapolated, and may be stiffer.
        density: [kg/m^3].
    """
    family = Family("identified", fit["law"])
    values = family.values(np.array(fit["unbounded"]["values"]), model, density)
    return analytic_law(family.law_spec(values), model.dt)
