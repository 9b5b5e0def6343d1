"""A noisy video of a ball under a law, and what is identified in it."""

from functools import partial

import numpy as np
import torch

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.fitting.identify import identify
from neuma_lib.splatting.observation import Observation
from tests.support import grounding_scene
from tests.support.grounding_scene import MODEL, observe
from tests.support.sim_scenes import law_spec as law

HEIGHT = 0.27
"""Of the ball's centre, so that it rests on the floor long enough for three held-out frames."""
ball = partial(grounding_scene.ball, height=HEIGHT)
V0 = (0.5, -1.5, 0.0)
FRAMES = tuple(range(0, 121, 8))
SQUARES = (4, 8, 32)

ELASTIC = law("hencky")
PLASTIC = law("hencky", "von_mises", yield_stress=4e3)
FLUID = law("hencky", "viscous_flow", viscosity=60)


def settings(families: dict, **options) -> IdentifyConfig:
    families = {name: LawConfig(**spec) for name, spec in families.items()}
    return IdentifyConfig(families=families, **{"pyramid": SQUARES, "pose_tolerance": 0.0, **options})


def pixel_noise(images: torch.Tensor) -> torch.Tensor:
    return 0.01 * torch.randn(images.shape, generator=torch.Generator().manual_seed(5), dtype=images.dtype)


def known(body, std=(0.0,) * 6, v0=V0) -> InitialMotion:
    """The true initial motion, up to standard deviations."""
    centre = (body.mass @ body.x0 / body.mass.sum()).numpy()
    return InitialMotion(np.array(v0), np.zeros(3), centre, np.eye(3), np.array(std))


def identified_in(spec: dict, families: dict, noise=pixel_noise, motion=None, **options):
    """What is identified in a noisy video of the ball under a law."""
    body, seen = video_of(spec, V0, FRAMES, noise)
    other_videos = options.pop("other_videos", ())
    chosen = settings(families, covariance_from="elastic", **options)
    return identify(MODEL, motion or known(body), body, seen, chosen, other_videos=other_videos)


def video_of(spec: dict, v0, frames, noise=pixel_noise):
    """The ball, and a noisy video of it under a law."""
    body = ball()
    seen = observe(body, v0, frames, spec)
    return body, Observation(seen.frames, seen.images + noise(seen.images), seen.cameras)
