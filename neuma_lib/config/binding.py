"""Settings of the binding of Gaussians to particles."""

from pydantic import Field

from neuma_lib.config.base import Section, internal


class BindingConfig(Section):
    """Gaussian-particle binding (paper Algorithm 1)."""

    confidence: float = internal(
        0.95, "probability tau of the chi-squared test that defines the ellipsoid", gt=0, lt=1
    )
    max_neighbours: int | None = Field(
        10,
        ge=1,
        description="maximum number of particles of a Gaussian, the nearest; null: all in the ellipsoid (paper)",
    )
    equal_mass: bool = internal(False, "give all particles, added ones included, equal volumes (paper)")
