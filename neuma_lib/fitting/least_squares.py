"""Few unknowns, many pixels: Levenberg-Marquardt on images, and the uncertainty of what it finds.

Images enter as sums over blocks of the image, J^T J and J^T r, so that a block can be left out afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

BLOCKS = 4
"""Blocks along a side of the image that the uncertainty leaves out in turn."""
LEAST_COST = 1e-12
"""Of images that agree exactly: a fit without residuals must not make the equations singular."""
_SHOWN = 1e-6  # part of the curvature in a block that shows the body
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-9, 1e6


@dataclass(frozen=True)
class Linearisation:
    """The least-squares problem around some unknowns: residuals r, Jacobian J, summed up over all pixels.

    Attributes:
        curvatures: J^T J of every block of the image, summed over the frames, shape (blocks, k, k).
        scores: J^T r of every block, shape (blocks, k).
        cost: r^T r.
        rms: root mean square of r.
    """

    curvatures: np.ndarray
    scores: np.ndarray
    cost: float
    rms: float

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
        """Curvature that holds an unknown at 0 +- 1 if the residuals of a block count as one, being correlated."""
        return max(self.cost, LEAST_COST) / BLOCKS**2


class Residuals(Protocol):
    """Rendered minus observed colours as a function of k unknowns."""

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squares; infinite where there is no image."""

    def linearise(self, unknowns: np.ndarray, free: Sequence[int]) -> Linearisation:
        """The problem around unknowns whose cost is finite; columns that are not free are 0."""


def in_blocks(values: Tensor) -> Tensor:
    """Values (T, V, H, W, C) by the block of the image that they lie in, shape (V * blocks, values)."""
    T, V, H, W, C = values.shape
    tall, wide = -(-H // BLOCKS), -(-W // BLOCKS)
    full = torch.nn.functional.pad(values, (0, 0, 0, wide * BLOCKS - W, 0, tall * BLOCKS - H))
    split = full.reshape(T, V, BLOCKS, tall, BLOCKS, wide, C)
    return split.permute(1, 2, 4, 0, 3, 5, 6).reshape(V * BLOCKS**2, T * tall * wide * C)


def levenberg_marquardt(
    residuals: Residuals,
    start: np.ndarray,
    free: Sequence[int],
    penalty: Callable[[Linearisation], np.ndarray],
    least_gain: float,
    iterations: int,
    progress: Callable[[int, int, float], None] | None = None,
    longest: float | None = None,
) -> tuple[np.ndarray, Linearisation, int]:
    """Minimise |r(u)|^2 + u^T P u over the free unknowns.

    Args:
        residuals: r, with a finite cost at the start.
        start: unknowns, shape (k,).
        free: places of the unknowns that may move.
        penalty: P, shape (k, k), from the problem around the present unknowns.
        least_gain: part of the cost that a step must promise to save.
        iterations: most steps that are tried.
        progress: called with (step, steps, rms).
        longest: largest change of an unknown in a step; None: no limit.

    Returns:
        The unknowns (k,), the linearisation there in the free ones, and the number of accepted steps.
    """
    u, damping, accepted = start, _FIRST_DAMPING, 0
    fit = residuals.linearise(u, free)
    for iteration in range(iterations):
        P = penalty(fit)
        A, slope = (fit.curvature + P)[np.ix_(free, free)], (fit.slope + P @ u)[free]
        step = np.zeros(len(u))
        step[free] = -np.linalg.solve(A + damping * np.diag(np.diag(A)), slope)
        if longest is not None:
            step *= min(1.0, longest / max(np.abs(step).max(), LEAST_COST))
        if slope @ np.linalg.solve(A, slope) < least_gain * max(fit.cost, LEAST_COST):
            break
        trial = u + step
        before, after = fit.cost + u @ P @ u, residuals.cost(trial) + trial @ P @ trial
        if after < before:
            u, damping, accepted = trial, max(damping / 5, _LEAST_DAMPING), accepted + 1
            fit = residuals.linearise(u, free)
        else:
            damping *= 8
        if progress:
            progress(iteration + 1, iterations, fit.rms)
        if damping > _MOST_DAMPING:
            break
    return u, fit, accepted


def jackknife(fit: Linearisation, penalty: np.ndarray) -> np.ndarray:
    """Covariance (k, k) of a fit whose residuals are correlated over blocks of the image.

    Residuals come from what the static reconstruction cannot show (outline, shading, what turns into view), not from
    independent pixel noise: they last over all frames and reach over a good part of the body. So the blocks of the
    image are left out in turn, each in all frames, and the covariance is that of the jackknife,
    (n - 1)/n sum_b d_b d_b^T, where d_b = (H - H_b)^-1 g_b is how the estimate moves without block b. n counts the
    blocks that show the body. Unlike the sandwich H^-1 (sum_b g_b g_b^T) H^-1, this is not too small where few blocks
    decide (CR3 of cluster-robust regression: MacKinnon and White 1985; Cameron and Miller 2015).

    Args:
        fit: the problem around the estimate.
        penalty: curvature of what else holds the unknowns, shape (k, k).
    """
    H, P = fit.curvature, penalty
    shares = np.trace(fit.curvatures, axis1=1, axis2=2) / np.trace(H)
    moved = np.array(
        [np.linalg.pinv(H - part + P) @ g for part, g in zip(fit.curvatures, fit.scores, strict=True)]
    )
    n = max(2, int((shares > _SHOWN).sum()))
    return (n - 1) / n * moved.T @ moved
