"""Any law from the file of `neuma law export`, with numpy alone: law_in_numpy.py for networks, and here a
structured law or its analytic base alone.

What `identify` finds and `neuma_structured` learns: Hencky, neo-Hookean or fixed corotated elasticity, with no return
map, von Mises', Drucker and Prager's, or viscous flow, and the correction of the form "stretch"; formulas as in
neuma_lib/mechanics/structured.py.
"""

import math

import law_in_numpy
import numpy as np
from law_in_numpy import LAYERS, read, svd

SHEAR = {"hencky": [(1, 0)], "neo_hookean": [(1, 2)], "fixed_corotated": [(2, 2), (-1, 1)]}
RETURNS = ("identity", "von_mises", "drucker_prager", "viscous_flow")
LEAST, LIMIT, GROWTH, STRAIN, SMOOTH, COHESION = 0.05, 3.0, 2.0, 0.1, 0.05, 0.02


def load(path, dt=None):
    """Elasticity, plasticity and metadata; a law that flows by a rate follows the time step dt [s]."""
    arrays, about = read(path)
    if about["export"]["kind"] == "networks":
        return law_in_numpy.load(path)
    spec = about.get("structured") or about.get("analytic")
    elastic, plastic = ((spec or {}).get(part, {}) for part in ("elasticity", "plasticity"))
    known = (
        elastic.get("name") in SHEAR
        and plastic.get("name") in RETURNS
        and spec.get("form", "stretch") == "stretch"
    )
    if not known or "rank" in about:
        raise SystemExit(f"{path}: not a law of this example, or one with its adaptor apart")
    W_e, W_p = (
        [arrays[f"{part}.{layer}"] for layer in LAYERS if f"{part}.{layer}" in arrays]
        for part in ("elasticity", "plasticity")
    )
    if dt is not None and about["export"]["step"] == "fixed" and not math.isclose(dt, about["export"]["dt"]):
        raise SystemExit(
            f"{path} was learned at dt = {about['export']['dt']:g} s and is another material at {dt:g} s"
        )
    if dt is not None and "dt" in plastic:
        plastic["dt"] = dt

    def elasticity(F):
        """F (N, 3, 3) -> Kirchhoff stress tau = P F^T [Pa]."""
        U, sigma, _ = svd(F)
        return U * stress(sigma, elastic, network(sigma, W_e, 3))[:, None] @ U.swapaxes(1, 2)

    def plasticity(F):
        """Trial F (N, 3, 3) -> elastic F, once in a time step."""
        if plastic["name"] == "identity":
            return F
        U, sigma, Vh = svd(F)
        return U * returned(sigma, plastic, network(sigma, W_p, 5))[:, None] @ Vh

    return elasticity, plasticity, about["export"]


def lame(c):
    return c["E"] / (2 * (1 + c["nu"])), c["E"] * c["nu"] / ((1 + c["nu"]) * (1 - 2 * c["nu"]))


def network(sigma, W, outputs):
    """Numbers (N, 1) that change the base; zeros without a network."""
    if not W:
        return [np.zeros((len(sigma), 1))] * outputs
    strain = np.log(np.maximum(sigma, LEAST))
    t = strain.sum(1)
    dev = strain - t[:, None] / 3
    s = (dev**2).sum(1)
    size = s / (np.sqrt(s + SMOOTH**2) + SMOOTH)
    a = np.stack([t, size, 3 * math.sqrt(6) * dev.prod(1) / (s + SMOOTH**2)], axis=1) / STRAIN
    for k, W_layer in enumerate(W):
        a = np.concatenate([a, np.ones((len(a), 1))], axis=1) @ W_layer.T / (LIMIT if k == 2 else 1)
        a = a / np.sqrt(1 + a * a)
    return np.split(LIMIT * a, outputs, axis=1)


def stress(sigma, c, n):
    """Principal Kirchhoff stresses (N, 3) [Pa]."""
    mu, lam = lame(c)
    clamped, J = np.maximum(sigma, LEAST), sigma.prod(1, keepdims=True)
    strain = np.log(clamped)
    mean = {
        "hencky": (lam + 2 * mu / 3) * strain.sum(1, keepdims=True),
        "neo_hookean": mu * (sigma**2 - 1).mean(1, keepdims=True) + lam * np.log(np.maximum(J, LEAST**3)),
        "fixed_corotated": 2 * mu * ((sigma - 1) * sigma).mean(1, keepdims=True) + lam * J * (J - 1),
    }[c["name"]]
    shift, shear = 3 * np.expm1(n[2]) / (np.exp(n[2]) + 3), 0.0
    for factor, p in SHEAR[c["name"]]:
        m = (p + shift) * strain
        shear = shear + factor * strain * np.where(m == 0, 1, np.expm1(m) / np.where(m == 0, 1, m))
        shear = shear + (factor / p * (sigma**p - clamped**p) if p else 0)
    return np.exp(n[0]) * mean + 2 * mu * np.exp(n[1]) * (shear - shear.mean(1, keepdims=True))


def returned(sigma, c, n):
    """Principal stretches (N, 3) after the return."""
    mu, lam = lame(c)
    from_zero = lambda n: LIMIT / math.expm1(GROWTH * LIMIT) * np.expm1(GROWTH * np.maximum(n, 0))  # noqa: E731
    corrected = lambda x, n, unit=1.0: x * np.exp(n) if x > 0 else unit * from_zero(n)  # noqa: E731
    granular, sine = c["name"] == "drucker_prager", math.sin(math.radians(c.get("friction_angle", 0)))
    slope = (3 * lam + 2 * mu) / (2 * mu) * math.sqrt(2 / 3) * 2 * sine / (3 - sine) if granular else 0.0
    threshold = corrected(c["cohesion"] if granular else c["yield_stress"] / (2 * mu), n[0], COHESION)
    friction = corrected(slope, n[1])
    rate = c["viscosity"] / (mu * c["dt"]) if c["name"] == "viscous_flow" else 0.0
    fluidity = 1 / (1 + corrected(rate, n[2]))
    crush, dilation, compaction = from_zero(n[3]) / LIMIT, from_zero(n[4]) / LIMIT, from_zero(-n[4]) / LIMIT
    dilatancy = dilation * 2 * mu / (lam + 2 * mu / 3) * friction
    strain = np.log(np.maximum(sigma, LEAST))
    trace = strain.sum(1, keepdims=True)
    dev = strain - trace / 3
    norm = np.sqrt((dev**2).sum(1, keepdims=True))
    eased = trace * (1 - fluidity * crush)
    pressed = eased - 3 * threshold
    torn = granular & (pressed > dilatancy * norm)
    limit = -friction * pressed if granular else threshold + friction * np.maximum(-eased, 0)
    slips = ~torn & (norm > limit)
    share = fluidity / (1 + friction * dilatancy) * (1 - limit / np.where(slips, norm, 1))
    share = np.where(slips, share, 0)
    after = eased * (1 - compaction * share) - dilatancy * share * norm
    inside = np.where(slips | (crush > 0), np.exp(after / 3 + dev * (1 - share)), sigma)
    return np.where(torn, np.exp(threshold), inside)
