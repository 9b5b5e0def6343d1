"""Settings of the adaptation of the material law to a video."""

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Compared, Seed, internal
from neuma_lib.config.motion import MotionOptions


class TrainingConfig(MotionOptions):
    """Adaptation of the material law."""

    supervision: Literal["pixels", "particles"] = internal(
        "pixels", "images, or particles of the ground truth"
    )
    compare: Compared = Field(
        "colour",
        description="compared quantity: colours over white, or masks (coverage), for light that differs from the "
        "photographs",
    )
    rank: int | None = Field(
        16, ge=1, description="rank of the adaptor; null: train the base weights (w/o dM)"
    )
    alpha: float = internal(16.0, "the scale of the adaptor is alpha / rank", gt=0)
    seed: Seed = Field(0, description="seed of the initial weights of the adaptor")
    lr_scale: float = Field(1.0, gt=0, description="factor of both learning rates")
    covariance_gradient: bool = internal(True, "propagate image gradients to F through the covariances")
    iterations: int = Field(50, ge=1, description="optimiser steps, each with a full rollout")
    lr_elastic: float = Field(0.01, ge=0, description="learning rate of the elastic network")
    lr_plastic: float = Field(0.0005, ge=0, description="learning rate of the plastic network")
    lr_floor: float = internal(0.05, "fraction of the rates at the end of the cosine schedule", ge=0, le=1)
    betas: tuple[float, float] = internal((0.9, 0.99), "averaging factors of Adam")
    zero_gradients: bool = internal(
        True, "false: accumulate the clipped gradients of all iterations (authors)"
    )
    # The loss is divided by its first value before.
    gradient_clip: float = internal(1.0, "maximum gradient norm of each network", gt=0)
    # The weight of frame k is d^k. Early frames are fitted first.
    frame_weight_start: float = internal(
        0.5, "first d; it rises to 1 over a third of the iterations", gt=0, le=1
    )
    frame_weight_periods: int = internal(5, "k counts this many equal parts of the video", ge=1)
    warm_up: int = internal(5, "iterations in which the rates rise linearly from zero", ge=0)
    # A return to the best state halves the rates.
    recovery_growth: float = internal(1.1, "factor of halved rates for each accepted iteration", ge=1)
    diverged_ratio: float = internal(5.0, "multiple of the best loss that counts as diverged", gt=1)
    max_recoveries: int = internal(
        6, "maximum number of returns to the best state, then training is unstable", ge=0
    )
    checkpoint_every: int = internal(10, "iterations between checkpoints", ge=1)
    adjoint_precision: Literal["single", "half"] = internal(
        "single",
        "factors of the matrix products in the adjoint of a neural law on a GPU: 22 bits, or 11 bits, "
        "which is faster and has relative gradient errors of 1e-3",
    )
    memory: float | None = Field(
        None,
        gt=0,
        description="memory for the gradient of a rollout [GiB]; with less, steps are computed twice. null: no limit",
    )
