"""Bands of responses: they have the stated coverage for linear problems, and are wide without data."""

import numpy as np
import pytest
import torch

from neuma_lib.evaluation.bands import (
    LENGTH,
    SILENT,
    _log_moduli,
    band,
    corrected_draws,
    envelope,
    field_covariance,
)
from neuma_lib.evaluation.constants_draws import constants_draws
from neuma_lib.evaluation.material_point import sheared, stress
from neuma_lib.evaluation.response import inside, material_tests, response
from neuma_lib.fitting.families import Family
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.structured import LIMIT, WIDTH, initial_weights, network, structured_law

COVERED = 0.95
DT = 5e-4
MISES = {
    "elasticity": {"name": "hencky", "E": 1e5, "nu": 0.3},
    "plasticity": {"name": "von_mises", "yield_stress": 2e3},
}


def fit(spec=MISES, covariance=None, ties=()):
    """An identified.json of a family with some covariance."""
    family = Family("x", spec)
    k = len(family.constants)
    covariance = 0.01 * np.eye(k) if covariance is None else covariance
    best = {"law": spec, "unbounded": family.unbounded_dict(family.guess, covariance)}
    return {"best": best, "ties": list(ties), "families": dict.fromkeys(ties, best)}


def states(size, count=400, seed=0):
    """Random deformation gradients about I."""
    noise = torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + size * noise


def log_spread(laws, curve):
    """Standard deviations of the logarithm of a curve's size."""
    return np.log(np.abs(np.stack([curve(law).numpy() for law in laws]))).std(axis=0)


# ---- the linear model


def binomial_bounds(trials):
    """Interval that the number of successes leaves in one of 1000 cases, by the normal approximation."""
    std = (COVERED * (1 - COVERED) * trials) ** 0.5
    return COVERED * trials - 3.3 * std, COVERED * trials + 3.3 * std


def test_random_fields_cover_truths_of_their_model():
    """Truths from the prior, observed with noise at some states: at new states, seen or silent, 95 % are inside."""
    generator = np.random.default_rng(0)
    prior, noise, trials, covered = np.array([0.5, 0.5, 0.5, 2.0]), 0.3, 400, np.zeros(2)
    for _ in range(trials):
        x = generator.uniform(0, 1, 40)
        H = np.stack([np.sin(x), np.cos(2 * x), x**2, np.ones_like(x)], axis=1)
        truth = prior * generator.standard_normal((2, 4))
        information = len(x) / noise**2 * np.eye(2)
        covariance = field_covariance(H, information, prior)
        seen = [H @ row + noise * generator.standard_normal(len(x)) for row in truth]
        mean = covariance @ np.concatenate([H.T @ y for y in seen]) / noise**2
        draws = generator.multivariate_normal(mean, covariance, 400).reshape(400, 2, 4)
        for k, at in enumerate((0.5, 3.0)):
            h = np.array([np.sin(at), np.cos(2 * at), at**2, 1])
            low, high = np.quantile(draws[:, 1] @ h, [(1 - COVERED) / 2, (1 + COVERED) / 2])
            covered[k] += low <= truth[1] @ h <= high
    low, high = binomial_bounds(trials)
    assert ((low <= covered) & (covered <= min(high, trials))).all(), covered / trials


def test_constant_deviations_have_the_covariance_of_the_video():
    """With a free bias and no other feature the posterior is the covariance of the constants."""
    covariance = np.array([[0.04, 0.03], [0.03, 0.09]])
    posterior = field_covariance(np.ones((50, 1)), np.linalg.inv(covariance), np.array([1e6]))
    np.testing.assert_allclose(posterior, covariance, rtol=1e-9)


def test_constants_cover_truths_around_their_estimates():
    """Estimates scatter around the truth with the covariance that they claim: 95 % of the true curves are inside."""
    generator = np.random.default_rng(1)
    covariance = np.array([[0.02, 0.01, 0.0], [0.01, 0.04, 0.0], [0.0, 0.0, 0.01]])
    family = Family("x", MISES)
    truth, shear = family.unbounded(family.guess), torch.tensor([0.01, 0.05], dtype=torch.float64)
    true = sheared(analytic_law(MISES), shear).numpy()
    trials, covered = 100, np.zeros(2)
    for seed in range(trials):
        u = generator.multivariate_normal(truth, covariance)
        laws = constants_draws(fit(family.law_spec(family.bounded(u)), covariance), 0.0, DT, 100, seed)
        low, high = band(laws, lambda law: sheared(law, shear), COVERED)
        covered += (low <= true) & (true <= high)
    low, high = binomial_bounds(trials)
    assert (low <= covered).all() and (covered <= min(high, trials)).all(), covered / trials


# ---- laws


def test_samples_of_constants_keep_correlations():
    """A known flow stress with an unknown stiffness."""
    covariance = np.diag([0.25, 1e-8, 1e-8])
    laws = constants_draws(fit(covariance=covariance), 0.0, DT, 50, 0)
    E, flow = (
        np.array([getattr(law, part).values[key] for law in laws])
        for part, key in (("elasticity", "E"), ("plasticity", "yield_stress"))
    )
    assert np.log(E).std() == pytest.approx(0.5, rel=0.3) and np.log(flow).std() < 1e-3
    wider = constants_draws(fit(covariance=covariance), 0.1, DT, 200, 0)
    assert np.log([law.plasticity.values["yield_stress"] for law in wider]).std() == pytest.approx(
        0.1, rel=0.2
    )


def test_tied_families_have_equal_parts_of_the_samples():
    fitted = fit(ties=["other"])
    other = {"elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.3}}
    fitted["families"]["other"] = fit(other)["best"]
    laws = constants_draws(fitted, 0.0, DT, 20, 0)
    kinds = [type(law.elasticity).__name__ for law in laws]
    assert kinds.count("Hencky") == kinds.count("NeoHookean") == 10


def corrected(covariance=None, spec=MISES, size=0.05, count=80, **options):
    law = structured_law(spec, DT)
    before = {"model_std": 0.0, "spread": 3.0, **options}
    return corrected_draws(
        law, fit(spec, covariance)["best"], states(size), **before, dt=DT, count=count, seed=0
    )


def test_draws_around_a_correction_are_structured_and_centred():
    laws = corrected()
    F = states(0.03, count=20, seed=1)
    for law in laws[:3]:
        tau = stress(law, F)
        assert (tau - tau.mT).abs().max() < 1e-9 * tau.abs().max()
        assert stress(law, torch.eye(3, dtype=torch.float64)[None]).abs().max() < 1e-6
    at = torch.tensor([0.05], dtype=torch.float64)
    centre = float(sheared(structured_law(MISES, DT), at))
    ratios = np.log([float(sheared(law, at)) / centre for law in laws])
    assert abs(ratios.mean()) < 3 * ratios.std() / len(laws) ** 0.5


def test_bands_are_wide_in_states_without_data():
    covariance = 1e-3 * np.eye(3)
    shear = torch.tensor([0.1, 0.6], dtype=torch.float64)  # as the most strained states, and far beyond
    seen, silent = log_spread(corrected(covariance, size=0.02), lambda law: sheared(law, shear))
    known = log_spread(
        constants_draws(fit(covariance=covariance), 0.0, DT, 80, 0), lambda law: sheared(law, shear)
    )
    assert known.max() < seen < 0.2 and silent > 0.7 * SILENT
    centre = sheared(structured_law(MISES, DT), shear)
    ratios = torch.stack([(sheared(law, shear) / centre).log() for law in corrected(covariance, size=0.02)])
    assert ratios.abs().max() < LIMIT + 1e-9, "no wider than the correction may go"
    blind = log_spread(corrected(1e6 * np.eye(3), spread=0.5), lambda law: sheared(law, shear))
    assert (blind > 0.4).all()


def test_deviations_have_the_correlation_length_of_networks():
    """Correlation of the features of untrained networks at states that are LENGTH apart, their mean left out."""
    generator, result = torch.Generator().manual_seed(0), []
    last = 1e-3 * torch.eye(WIDTH, WIDTH + 1)  # gives the features themselves
    for seed in range(100):
        *hidden, _ = initial_weights(WIDTH, seed)
        z = 0.3 * (2 * torch.rand(64, 3, generator=generator) - 1)
        away = torch.randn(64, 3, generator=generator)
        ends = [z, z + LENGTH * away / away.norm(dim=1, keepdim=True)]
        H = [network(end, (*hidden, last)) for end in ends]
        mean = torch.cat(H).mean(dim=0)
        a, b = (h - mean for h in H)
        result.append(float((a * b).sum() / (a.square().sum() * b.square().sum()).sqrt()))
    assert np.mean(result) == pytest.approx(np.exp(-0.5), abs=0.05)


def test_corrected_draws_keep_correlations_of_constants():
    """Stiffness unknown and flow stress known: the band of the plateau is narrow, that of the slope is not."""
    family = Family("x", MISES)
    covariance = np.diag([0.2, 1e-6, 1e-6])
    assert family.constants == ("E", "nu", "yield_stress")

    def shear_stress(law):
        increment = torch.eye(3, dtype=torch.float64)[None].clone()
        increment[0, 0, 1] = 0.05
        small = sheared(law, torch.tensor([0.005], dtype=torch.float64))
        yielded = law.plasticity.evaluate(increment, tuple(w.double() for w in law.plasticity.weights()))
        return torch.cat([small, stress(law, yielded)[0, 0, 1][None]])

    slope, plateau = log_spread(corrected(covariance, size=0.02), shear_stress)
    assert plateau < 0.6 * slope


def test_uncertainties_of_moduli_follow_from_those_of_the_constants():
    """K = E / (3 (1 - 2 nu)), G = E / (2 (1 + nu)), and a yield strain in proportion to yield_stress / G."""
    family, du = Family("x", MISES), 0.1
    nu = MISES["elasticity"]["nu"]
    dnu = nu * (1 - nu / 0.5) * du  # nu is the logistic function of u times 0.5
    for covariance, expected in (
        (np.diag([du**2, 0, 0]), [du, du, -du]),
        (np.diag([0, du**2, 0]), [2 * dnu / (1 - 2 * nu), -dnu / (1 + nu), dnu / (1 + nu)]),
        (np.diag([0, 0, du**2]), [0, 0, du]),
    ):
        best = {"law": MISES, "unbounded": family.unbounded_dict(family.guess, covariance)}
        outputs, result = _log_moduli(best, DT, 0.0)
        assert outputs[:3] == [("elasticity", 0), ("elasticity", 1), ("plasticity", 0)]
        np.testing.assert_allclose(result[:3, :3], np.outer(expected, expected), rtol=1e-5, atol=1e-12)


def test_a_long_motion_is_represented_by_every_nth_state(monkeypatch):
    law, F = structured_law(MISES, DT), states(0.05)
    options = dict(model_std=0.0, spread=3.0, dt=DT, count=5, seed=0)

    def curves(visited):
        draws = corrected_draws(law, fit()["best"], visited, **options)
        return torch.stack([sheared(each, torch.tensor([0.02], dtype=torch.float64)) for each in draws])

    sparse = curves(F[::4])
    assert not torch.equal(curves(F), sparse)
    monkeypatch.setattr("neuma_lib.evaluation.bands.STATES", 99)
    assert torch.equal(curves(F), sparse)


def test_errors_that_all_images_share_widen_corrected_draws():
    """Images without any error leave `model_std` of every modulus."""
    shear = torch.tensor([0.01], dtype=torch.float64)

    def spread(model_std):
        draws = corrected(1e-6 * np.eye(3), size=0.02, count=200, model_std=model_std)
        return log_spread(draws, lambda law: sheared(law, shear))[0]

    assert spread(0.0) < 0.02
    assert spread(0.1) > 0.09  # the standard deviation of 200 samples has a relative error of 5 %


def test_envelope_contains_all_replicates():
    low, high = envelope([(np.array([0.0, 2]), np.array([1.0, 3])), (np.array([1.0, 1]), np.array([2.0, 2]))])
    assert low.tolist() == [0, 1] and high.tolist() == [2, 3]


# ---- responses


@pytest.mark.parametrize("part", ["elastic", "viscous", "granular"])
def test_responses_of_all_kinds_of_laws_have_bands(part):
    plastic = {
        "elastic": {"name": "identity"},
        "viscous": {"name": "viscous_flow", "viscosity": 50.0},
        "granular": {"name": "drucker_prager", "friction_angle": 30.0},
    }[part]
    spec = {"elasticity": MISES["elasticity"], "plasticity": plastic}
    truth = analytic_law(spec, DT)
    tests = material_tests(truth, states(0.03), rate=50.0, total_shear=0.2, dt=DT)
    for law, draws in (
        (truth, constants_draws(fit(spec), 0.02, DT, 10, 0)),
        (structured_law(spec, DT), corrected(spec=spec, count=10)),
    ):
        for name, test in tests.items():
            curve = response(law, truth, test, draws)
            assert len(curve["x"]) == len(curve["stress"]) == len(curve["true"])
            np.testing.assert_allclose(curve["stress"], curve["true"], rtol=1e-3, atol=5.0)
            assert np.isfinite([curve["band"]["low"], curve["band"]["high"]]).all()
            assert inside(curve) > 0.8, name
    alone = response(truth, truth, tests["shear"])
    assert "band" not in alone


def test_inside_counts_visited_points_only():
    results = {"x": [0, 1, 2, 3], "true": [0, 1, 2, 3], "visited": [0.5, 2.5], "by_stress": False}
    results["band"] = {"x": [0, 1, 2, 3], "low": [9, 0, 3, 9], "high": [9, 2, 4, 9]}
    assert inside(results) == 0.5
    assert inside({**results, "visited": [5, 6]}) is None
    assert inside({**results, "true": [0, 0, 0, 9], "by_stress": True, "visited": [0, 0.1]}) == pytest.approx(
        1 / 3
    )
