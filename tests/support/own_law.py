"""A law of the user, which tests put into a project."""

from neuma_lib.mechanics.catalogue import POISSON, YOUNG, Constant
from neuma_lib.mechanics.elasticity import AnalyticElasticity


class CubicHencky(AnalyticElasticity, name="cubic_hencky"):
    """tau_i = 2 mu eps_i (1 + b eps_i^2) + lam tr(eps)."""

    constants = {"E": YOUNG, "nu": POISSON, "b": Constant("1", 0.0)}

    def principal(self, sigma, mu, lam, b):
        eps = sigma.log()
        return 2 * mu * eps * (1 + b * eps**2) + lam * eps.sum(1, keepdim=True)
