"""Levenberg-Marquardt on images for few unknowns, and the uncertainty of the result.

Images are reduced to sums J^T J and J^T r per block, so that blocks can be left out afterwards.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

BLOCKS = 4  # blocks along a side of the image for the jackknife
MIN_COST = 1e-12  # lower bound of the cost, so that exact agreement does not make the equations singular
_MIN_SHARE = 1e-6  # share of the curvature of a block that shows the body
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e-9, 1e6
_SECANT_DAMPING = 0.03  # at least, with an updated J, which is inaccurate where the images change little
_FAILED_DAMPING, _DAMPING_FACTOR = 0.5, 16.0  # at least, and its growth, after a step that fails
_ROUGH_GAIN = 0.05  # predicted relative gain of a failed step that ends a rough fit


@dataclass(frozen=True)
class Linearisation:
    """The linearised least-squares problem with residuals r and Jacobian J, summed over pixels."""

    curvatures: np.ndarray  # J^T J of every block of the image, summed over frames, shape (blocks, k, k)
    scores: np.ndarray  # J^T r of every block, shape (blocks, k)
    cost: float  # r^T r
    rms: float  # root mean square of r
    # whether J has been differentiated here, instead of updated from a former point (`secant_update`)
    exact: bool = True

    @property
    def curvature(self) -> np.ndarray:
        """J^T J, shape (k, k)."""
        return self.curvatures.sum(axis=0)

    @property
    def slope(self) -> np.ndarray:
        """J^T r, shape (k,)."""
        return self.scores.sum(axis=0)

    @property
    def block_cost(self) -> float:
        """Curvature of a prior 0 +- 1 on an unknown, with the correlated residuals of a block counted as one."""
        return max(self.cost, MIN_COST) / BLOCKS**2


class Residuals(Protocol):
    """Rendered minus observed colours as a function of k unknowns."""

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squares, infinite if there is no image."""

    def linearise(self, unknowns: np.ndarray, free: Sequence[int], exact: bool = True) -> Linearisation:
        """The problem linearised at unknowns with a finite cost; columns that are not free are 0. Unless ``exact``, J
        may be updated from that at a former point."""


def in_blocks(values: Tensor) -> Tensor:
    """Values (T, V, H, W, C) grouped by block of the image, shape (V * blocks, values)."""
    T, V, H, W, C = values.shape
    tall, wide = -(-H // BLOCKS), -(-W // BLOCKS)
    full = torch.nn.functional.pad(values, (0, 0, 0, wide * BLOCKS - W, 0, tall * BLOCKS - H))
    split = full.reshape(T, V, BLOCKS, tall, BLOCKS, wide, C)
    return split.permute(1, 2, 4, 0, 3, 5, 6).reshape(V * BLOCKS**2, T * tall * wide * C)


def block_sums(columns: Sequence[Tensor], residual: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """J^T J and J^T r of every block of the image, summed over frames, shapes (V * blocks, k, k) and (V * blocks, k).

    Only pixels that depend on an unknown are summed, since most show the background.

    Args:
        columns: the k columns of J, shape (T, V, H, W, C) each.
        residual: r, of the same shape.
    """
    V, H, W, C = residual.shape[1:]
    tall, wide = -(-H // BLOCKS), -(-W // BLOCKS)
    depends = torch.zeros(residual.shape[:-1], dtype=torch.bool, device=residual.device)
    for column in columns:
        depends |= (column != 0).any(dim=-1)
    t, v, y, x = depends.nonzero(as_tuple=True)
    block = (v * BLOCKS + y // tall) * BLOCKS + x // wide
    order = block.argsort(stable=True)
    sizes = (C * block.bincount(minlength=V * BLOCKS**2)).tolist()
    at = (t[order], v[order], y[order], x[order])
    J = torch.stack([column[at].flatten() for column in columns], dim=-1).double().split(sizes)
    r = residual[at].flatten().double().split(sizes)
    curvatures = torch.stack([own.mT @ own for own in J])
    scores = torch.stack([own.mT @ values for own, values in zip(J, r, strict=True)])
    return curvatures.cpu().numpy(), scores.cpu().numpy()


def levenberg_marquardt(
    residuals: Residuals,
    start: np.ndarray,
    free: Sequence[int],
    penalty: Callable[[Linearisation], np.ndarray],
    min_gain: float,
    iterations: int,
    progress: Callable[[int, int, float], None] | None = None,
    longest: float | None = None,
    secant: bool = False,
    rough: bool = False,
    limit: float = math.inf,
) -> tuple[np.ndarray, Linearisation, int]:
    """Minimise |r(u)|^2 + u^T P u over the free unknowns.

    Args:
        residuals: r, with a finite cost at ``start``.
        start: initial unknowns, shape (k,).
        free: indices of the free unknowns.
        penalty: P, shape (k, k), from the linearised problem.
        min_gain: minimum predicted relative decrease of the cost in a step. Steps that fail are shortened until they
            predict less, since the cost is not smoother than that.
        iterations: maximum number of attempted steps.
        progress: called with (step, steps, rms).
        longest: largest change of an unknown in a step, None for no limit.
        secant: whether J may be updated instead of differentiated, at the start from a former fit. It is differentiated
            after a step that fails, and before the result.
        rough: whether the result may have an updated J, also after a failed step that predicted little.
        limit: cost beyond which a predicted minimum is of no interest. The fit ends there.

    Returns:
        The unknowns (k,), the linearisation there in the free ones, and the number of accepted steps.
    """
    u, accepted = start, 0
    damping, lowest = (_SECANT_DAMPING,) * 2 if secant else (_FIRST_DAMPING, _MIN_DAMPING)
    fit = residuals.linearise(u, free, exact=not secant)
    for iteration in range(iterations):
        P = penalty(fit)
        A, slope = (fit.curvature + P)[np.ix_(free, free)], (fit.slope + P @ u)[free]
        step = np.zeros(len(u))
        step[free] = -np.linalg.solve(A + damping * np.diag(np.diag(A)), slope)
        if longest is not None:
            step *= min(1.0, longest / max(np.abs(step).max(), MIN_COST))
        if fit.cost - slope @ np.linalg.solve(A, slope) > limit:
            break
        gain = -(2 * slope + A @ step[free]) @ step[free] / max(fit.cost, MIN_COST)
        if gain < min_gain:
            if fit.exact or rough:
                break
            fit = residuals.linearise(u, free)
            continue
        trial = u + step
        before, after = fit.cost + u @ P @ u, residuals.cost(trial) + trial @ P @ trial
        if after < before:
            u, damping, accepted = trial, max(damping / 5, lowest), accepted + 1
            fit = residuals.linearise(u, free, exact=not secant)
        elif fit.exact:
            damping = max(_FAILED_DAMPING, _DAMPING_FACTOR * damping)
        elif rough and gain < _ROUGH_GAIN:
            break
        else:
            fit = residuals.linearise(u, free)
        if progress:
            progress(iteration + 1, iterations, fit.rms)
        if damping > _MAX_DAMPING:
            break
    if not (fit.exact or rough or fit.cost > limit):
        fit = residuals.linearise(u, free)
    return u, fit, accepted


def secant_update(columns: Sequence[Tensor], step: Sequence[float], remainder: Tensor) -> list[Tensor]:
    """Columns of the Jacobian after a step (Broyden 1965): the smallest change that explains the step.

    Args:
        columns: before the step.
        step: change of the unknowns of the columns, not all 0.
        remainder: change of the residuals minus that predicted by all columns, shaped like a column.
    """
    size = sum(part**2 for part in step)
    return [column + part / size * remainder for column, part in zip(columns, step, strict=True)]


def jackknife(fit: Linearisation, penalty: np.ndarray) -> np.ndarray:
    """Covariance (k, k) of a fit with residuals that are correlated within blocks of the image.

    Residuals are errors of the static reconstruction (outline, shading, disocclusion) rather than independent pixel
    noise. They persist over frames and extend over large parts of the body. The blocks of the image are therefore left
    out in turn, each in all frames, with the jackknife covariance (n - 1)/n sum_b d_b d_b^T, where d_b = (H - H_b)^-1
    g_b is the change of the estimate without block b, and n counts the blocks that show the body. Unlike the sandwich
    H^-1 (sum_b g_b g_b^T) H^-1, this is not too small for few influential blocks (CR3 of cluster-robust regression:
    MacKinnon and White 1985; Cameron and Miller 2015).

    Args:
        fit: the problem linearised at the estimate.
        penalty: curvature of other terms on the unknowns, shape (k, k).
    """
    H, P = fit.curvature, penalty
    shares = np.trace(fit.curvatures, axis1=1, axis2=2) / np.trace(H)
    d = np.array(
        [np.linalg.pinv(H - part + P) @ g for part, g in zip(fit.curvatures, fit.scores, strict=True)]
    )
    n = max(2, int((shares > _MIN_SHARE).sum()))
    return (n - 1) / n * d.T @ d


def laplace(fit: Linearisation, spreads: np.ndarray) -> np.ndarray:
    """Covariance (k, k) of a fit by the Laplace approximation: the inverse curvature times the mean squared residual.

    It takes residuals for independent normal noise of the pixels, so that it is far too small (`jackknife`). Calibrated
    intervals are compared with it.

    Args:
        fit: the problem linearised at the estimate.
        spreads: prior standard deviations of the unknowns about 0, shape (k,).
    """
    noise = fit.rms**2
    return noise * np.linalg.pinv(fit.curvature + noise * np.diag(spreads**-2.0))
