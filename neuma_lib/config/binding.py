"""Settings of the binding of Gaussians to particles."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section


class BindingConfig(Section):
    """Gaussian-particle binding (paper Algorithm 1)."""

    confidence: float = Field(
        0.95, gt=0, lt=1, description="probability tau of the chi-squared test, which defines the ellipsoid"
    )
    max_neighbours: int | None = Field(
        10, ge=1, description="nearest particles kept for a Gaussian; null: all inside the ellipsoid (paper)"
    )
    equal_mass: bool = Field(
        False, description="all particles, added ones too, share the volume equally (paper)"
    )
