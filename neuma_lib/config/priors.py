"""Settings of the priors: analytic laws, and the networks trained on them."""

from pydantic import Field

from neuma_lib.config.base import Section, Seed, internal
from neuma_lib.config.laws import LawConfig


class RegressionConfig(Section):
    """Regression on pairs (F -> tau) and (F_trial -> F)."""

    throws: int = internal(8, "launches of a cube simulated with the analytic law", ge=1)
    side_particles: int = internal(8, "particles along an edge of the cube", ge=1)
    grid: int = internal(20, "grid cells along each side of the box", ge=8)
    duration: float = internal(0.45, "duration of a launch [s]", gt=0)
    dt: float = internal(1e-3, "maximum time step [s], reduced to a Courant number of 0.5", gt=0)
    samples: int = Field(131072, ge=1, description="pairs that a network is fitted to, in each round")
    noise_low: float = internal(1e-3, "minimum size of the log-uniform random log strains", gt=0)
    noise_high: float = internal(0.3, "maximum size of the log-uniform random log strains", gt=0)
    rounds: int = Field(
        2, ge=1, description="rounds of data; later rounds add states of rollouts with the networks"
    )
    # With faster launches, while the networks crush elements that the law does not.
    further_rounds: int = internal(2, "maximum number of additional, longer rounds", ge=0)
    iterations: int = Field(2500, ge=1, description="SOAP iterations of a network, in each round")
    batch: int = internal(1024, "pairs per iteration", ge=1)
    learning_rate: float = internal(2e-2, "step of SOAP, with warm-up and cosine decay in each round", gt=0)
    # Relative to the median of the visited targets.
    floor: float = internal(0.3, "size below which targets are fitted in absolute terms", gt=0)


class PriorsConfig(Section):
    """Pre-trained neural constitutive laws."""

    laws: dict[str, LawConfig] = Field({}, description="analytic law behind each prior, by name")
    seed: Seed = internal(0, "seed of the data and the initial weights")
    regression: RegressionConfig = Field(RegressionConfig(), description="the regression")
