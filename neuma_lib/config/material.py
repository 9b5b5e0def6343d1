"""Settings of the adaptation of the material law to a video."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Compared
from neuma_lib.config.motion import MotionOptions


class MaterialConfig(MotionOptions):
    """Adaptation of the material law: what is trained, on what, how."""

    supervision: Literal["pixels", "particles"] = Field(
        "pixels", description="images, or ground-truth particles"
    )
    compare: Compared = Field(
        "colour",
        description="what of the images counts: colours over white, or masks alone, how far the body covers a pixel, "
        "where the light differs from that of the photographs",
    )
    rank: int | None = Field(
        16, ge=1, description="rank of the adaptor; null trains the base weights (w/o dM)"
    )
    alpha: float = Field(16.0, gt=0, description="the adaptor's scale is alpha / rank")
    seed: int = Field(0, description="seed of the adaptor's initial weights")
    lr_scale: float = Field(1.0, gt=0, description="factor on both learning rates (sweeps, ablations)")
    covariance_gradient: bool = Field(True, description="let image gradients reach F through the covariances")
    iterations: int = Field(50, ge=1, description="optimiser steps, one full rollout each")
    lr_elastic: float = Field(0.01, ge=0, description="learning rate of the elastic network")
    lr_plastic: float = Field(0.0005, ge=0, description="learning rate of the plastic network")
    lr_floor: float = Field(
        0.05, ge=0, le=1, description="fraction of the learning rates that the cosine schedule ends at"
    )
    betas: tuple[float, float] = Field((0.9, 0.99), description="Adam's averaging factors")
    zero_gradients: bool = Field(
        True,
        description="false adds every iteration's gradient to the clipped ones before it, as the authors' released "
        "loop does",
    )
    gradient_clip: float = Field(
        1.0,
        gt=0,
        description="largest gradient norm of each network; the loss is divided by its first value before",
    )
    frame_weight_start: float = Field(
        0.5,
        gt=0,
        le=1,
        description="d of the frame weights d^k at the first iteration; it rises to 1 over the first third",
    )
    frame_weight_periods: int = Field(
        5,
        ge=1,
        description="k counts this many equal parts of the video, so that early frames are fitted first",
    )
    warm_up: int = Field(5, ge=0, description="iterations over which the rates rise linearly from zero")
    recovery_growth: float = Field(
        1.1,
        ge=1,
        description="after a return to the best state the rates are halved; each accepted iteration multiplies "
        "them by this, up to their full size",
    )
    penalty: float = Field(
        0.0,
        ge=0,
        description="weight of the mean squared relative change of stress and return map on states that the video did "
        "not visit, beside the loss divided by its first value; 0: none (paper)",
    )
    diverged_ratio: float = Field(
        5.0,
        gt=1,
        description="a loss above this multiple of the best one so far (at equal frame weights) counts as diverged",
    )
    max_recoveries: int = Field(
        6,
        ge=0,
        description="after more returns to the best state than this, training ends there, marked as unstable",
    )
    checkpoint_every: int = Field(10, ge=1, description="iterations between checkpoints")
    adjoint_precision: Literal["single", "half"] = Field(
        "single",
        description="matrix products in the adjoint of a neural law on a GPU: single takes factors of 22 bits, half of "
        "11, which is faster. Motion and images stay as they are; with half, gradients of one call with respect to F "
        "and to the weights are off by about 1e-3 of their norm",
    )
    memory: float | None = Field(
        None,
        gt=0,
        description="most GiB for what a rollout's gradient keeps; with less, steps are computed again, see `rollout`. "
        "null: no limit",
    )
