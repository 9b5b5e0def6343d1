"""Nonlinear least squares, its derivatives and its covariances, against closed forms."""

import math

import numpy as np
import pytest
import torch

from neuma_lib.fitting.least_squares import (
    BLOCKS,
    Linearisation,
    block_sums,
    in_blocks,
    jackknife,
    laplace,
    levenberg_marquardt,
    secant_update,
)

pytestmark = pytest.mark.core


def test_the_laplace_approximation_is_the_covariance_for_independent_noise():
    """Of a linear problem with the prior, against the normal equations written out, and against many noisy problems."""
    generator, sigma, spreads = np.random.default_rng(0), 0.3, np.array([2.0, 0.5, 1.0])
    J = generator.standard_normal((400, 3))
    truth = spreads * generator.standard_normal((500, 3))
    residuals = truth @ J.T + sigma * generator.standard_normal((500, 400))
    precision = J.T @ J / sigma**2 + np.diag(spreads**-2.0)
    fit = Linearisation((J.T @ J)[None], np.zeros((1, 3)), 400 * sigma**2, sigma)
    covariance = laplace(fit, spreads)
    np.testing.assert_allclose(covariance, np.linalg.inv(precision), rtol=1e-10)
    errors = residuals @ J @ covariance / sigma**2 - truth
    np.testing.assert_allclose(errors.std(axis=0), np.sqrt(np.diag(covariance)), rtol=5 * 500**-0.5)


class Line:
    """Residuals a u - b of one frame, with sign changes of u beyond a wall."""

    def __init__(self, a: np.ndarray, b: np.ndarray, wall: float = math.inf):
        self.a, self.b, self.wall = a, b, wall

    def cost(self, u):
        return math.inf if u[0] > self.wall else float(((self.a @ u - self.b) ** 2).sum())

    def linearise(self, u, free, exact=True):
        r = self.a @ u - self.b
        columns = self.a.reshape(16, -1, self.a.shape[1])
        scores = (columns.transpose(0, 2, 1) @ r.reshape(16, -1, 1))[..., 0]
        return Linearisation(
            columns.transpose(0, 2, 1) @ columns, scores, float(r @ r), float(np.sqrt(r @ r))
        )


class Bend:
    """Residuals of exp(u_0), u_0 + u_1 and 0.1 u_1 to targets, with updated derivatives unless they must be exact."""

    def __init__(self, targets: np.ndarray):
        self.targets, self.differentiated, self.at, self.J = targets, 0, None, None

    def residual(self, u):
        return np.array([np.exp(u[0]), u[0] + u[1], 0.1 * u[1]]) - self.targets

    def cost(self, u):
        return float((self.residual(u) ** 2).sum())

    def linearise(self, u, free, exact=True):
        r, known = self.residual(u), self.at is not None
        if exact or not known:
            self.J = np.array([[np.exp(u[0]), 0.0], [1.0, 1.0], [0.0, 0.1]])
            self.differentiated += 1
        elif (step := u - self.at).any():
            change = torch.from_numpy(r - self.residual(self.at) - self.J @ step)
            columns = secant_update(list(torch.from_numpy(self.J.T.copy())), step.tolist(), change)
            self.J = torch.stack(columns, dim=1).numpy()
            np.testing.assert_allclose(self.J @ step, r - self.residual(self.at), atol=1e-12)
        self.at = u.copy()
        exact = exact or not known
        return Linearisation((self.J.T @ self.J)[None], (self.J.T @ r)[None], self.cost(u), 1.0, exact)


def test_updated_derivatives_reach_the_same_minimum_with_fewer_differentiations():
    none = lambda fit: np.zeros((2, 2))  # noqa: E731
    targets, results, counts = np.array([3.0, 0.5, 0.2]), [], []
    for secant in (False, True):
        problem = Bend(targets)
        u, fit, _ = levenberg_marquardt(problem, np.zeros(2), [0, 1], none, 1e-14, 40, secant=secant)
        assert fit.exact and np.abs(fit.slope).max() < 1e-5
        results.append(u)
        counts.append(problem.differentiated)
    np.testing.assert_allclose(*results, atol=1e-5)
    assert counts[1] < counts[0]


def test_a_rough_fit_and_a_hopeless_one_differentiate_less():
    """A rough fit ends with updated derivatives near the minimum, one beyond the limit of the cost at once."""
    none = lambda fit: np.zeros((2, 2))  # noqa: E731
    targets = np.array([3.0, 0.5, 0.2])
    problem = Bend(np.array([3.0, 0.5, 0.2]))
    hopeless = Bend(np.array([3.0, 0.5, 9.0]))
    exact, _, _ = levenberg_marquardt(Bend(targets), np.zeros(2), [0, 1], none, 1e-14, 40)
    u, fit, _ = levenberg_marquardt(problem, np.zeros(2), [0, 1], none, 1e-6, 40, secant=True, rough=True)
    assert not fit.exact and problem.differentiated == 1
    np.testing.assert_allclose(u, exact, atol=0.02)
    u, fit, accepted = levenberg_marquardt(
        hopeless, np.zeros(2), [0, 1], none, 1e-6, 40, secant=True, limit=1.0
    )
    assert accepted == 0 and hopeless.differentiated == 1 and not u.any()


def test_sums_of_blocks_are_those_of_all_pixels():
    """Of images that the number of blocks does not divide, with background that depends on nothing."""
    generator = torch.Generator().manual_seed(3)
    shape, k = (2, 3, 10, 13, 3), 4
    *columns, r = (torch.randn(shape, generator=generator) for _ in range(k + 1))
    for column in columns:
        column[:, :, :4] = 0.0
    curvatures, scores = block_sums(columns, r)
    assert curvatures.shape == (3 * BLOCKS**2, k, k) and scores.shape == (3 * BLOCKS**2, k)
    J = torch.stack([in_blocks(column) for column in columns], dim=-1).double()
    np.testing.assert_allclose(curvatures, J.mT @ J, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(
        scores, (J.mT @ in_blocks(r).double()[..., None])[..., 0], rtol=1e-10, atol=1e-12
    )


def test_least_squares_of_a_line_and_its_jackknife():
    """Independent noise: the jackknife's variance is that of linear regression, sigma^2 (A^T A)^-1, and infinite cost
    is a wall that is not passed."""
    generator = np.random.default_rng(0)
    a, errors, stds = generator.standard_normal((1600, 2)), [], []
    none = lambda fit: np.zeros((2, 2))  # noqa: E731
    for _ in range(20):
        b = a @ [2.0, -1.0] + 0.3 * generator.standard_normal(1600)
        u, fit, _ = levenberg_marquardt(Line(a, b), np.zeros(2), [0, 1], none, 1e-12, 20)
        errors.append(u - [2.0, -1.0])
        stds.append(np.sqrt(np.diag(jackknife(fit, none(fit)))))
    expected = 0.3 * np.sqrt(np.diag(np.linalg.inv(a.T @ a)))
    np.testing.assert_allclose(np.mean(stds, axis=0), expected, rtol=0.25)
    assert np.abs(errors).max() < 4 * expected.max()
    u, *_ = levenberg_marquardt(Line(a, b, wall=1.5), np.zeros(2), [0, 1], none, 1e-12, 40)
    assert 1.0 < u[0] <= 1.5
