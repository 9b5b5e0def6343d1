"""Settings of the priors: which analytic laws neural ones are trained on, and how."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section
from neuma_lib.config.laws import LawConfig


class RegressionConfig(Section):
    """Regression on pairs (F -> tau) and (F_trial -> F)."""

    throws: int = Field(8, ge=1, description="cubes simulated with the analytic law")
    side_particles: int = Field(8, ge=1, description="particles along a cube's edge")
    grid: int = Field(20, ge=8, description="grid nodes along the box")
    duration: float = Field(0.45, gt=0, description="length of a throw [s]")
    dt: float = Field(1e-3, gt=0, description="longest time step [s]; shortened to a Courant number of 0.5")
    samples: int = Field(131072, ge=1, description="pairs a network is fitted to, in each round")
    noise_low: float = Field(1e-3, gt=0, description="smallest size of the log-uniform random log strains")
    noise_high: float = Field(0.3, gt=0, description="largest size of the log-uniform random log strains")
    rounds: int = Field(
        2,
        ge=1,
        description="rounds of data; from the second on, states that the networks' own rollouts visit are added",
    )
    further_rounds: int = Field(
        2,
        ge=0,
        description="longer rounds after these at most, with faster throws added to the data, while the networks crush "
        "elements in such throws that the law does not",
    )
    iterations: int = Field(2500, ge=1, description="SOAP iterations a network, in each round")
    batch: int = Field(1024, ge=1, description="pairs an iteration")
    learning_rate: float = Field(
        2e-2, gt=0, description="SOAP's step, warmed up and decayed to zero by a cosine in each round"
    )
    floor: float = Field(
        0.3,
        gt=0,
        description="targets smaller than this fraction of the median visited one are fitted in absolute terms",
    )


class PriorsConfig(Section):
    """Pre-trained neural constitutive laws."""

    laws: dict[str, LawConfig] = Field({}, description="analytic law that each prior is trained on, by name")
    seed: int = Field(0, description="seed of the data and of the initial weights")
    regression: RegressionConfig = Field(RegressionConfig(), description="the regression")
