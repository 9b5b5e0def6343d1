"""Bodies that touch each other on one grid."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neuma_lib.errors import InputError

MAX_BODIES = 5
"""Bodies of a simulation."""
MAX_RANGES = 2 * MAX_BODIES
"""Ranges of particles that belong to one body: that of each body, and that of its viscous branches."""


@dataclass(frozen=True)
class Pair:
    """Constants of the contact of two bodies (`body_contact`).

    Attributes:
        first, second: indices of the bodies, first < second.
        friction: Coulomb coefficient, as of a `Collider`. With infinity they stick while they press on each other.

    Raises:
        InputError: a value is out of range.
    """

    first: int
    second: int
    friction: float = math.inf

    def __post_init__(self):
        if not 0 <= self.first < self.second < MAX_BODIES:
            given = f"bodies {self.first} and {self.second}"
            raise InputError("pair", f"{given} must ascend from 0 to at most {MAX_BODIES - 1}")
        if not self.friction >= 0:
            raise InputError("pair.friction", f"{self.friction!r} must be a number of at least 0")


def pair_table(
    pairs: Sequence[Pair], frictions: Sequence[float], fractions: Sequence[float], largest: float
) -> np.ndarray:
    """Constants of B bodies for the kernels, shape (B, B + 1).

    The first B columns are the frictions of all pairs, at most ``largest``, by default that of `Pair`. The last is the
    volume fraction of a node per mass [1/kg].

    Args:
        frictions: Coulomb coefficients of the given pairs, which replace those of the pairs.
        fractions: volume fraction per mass of each body [1/kg], shape (B,).
    """
    table = np.full((len(fractions), len(fractions) + 1), largest)
    table[:, -1] = fractions
    for pair, friction in zip(pairs, frictions, strict=True):
        table[[pair.first, pair.second], [pair.second, pair.first]] = min(friction, largest)
    return table
