"""Particle-GS (paper Sec. 3.3): Gaussians moved by simulated particles and rendered to images."""

from collections.abc import Iterator

import torch
from torch import Tensor

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.deformation import arms_at_rest, deform
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import rasterize, rasterized_error

_CACHE_BYTES = 16e6  # size of the buffers of one batch of frames on a CPU, so that they stay in its cache
_GPU_SHARE, _GPU_BYTES = 1 / 16, 4e9
"""The same on a GPU: fraction of its memory, and maximum. A batch has an overhead of about one millisecond."""


def _batch_bytes(device: torch.device) -> float:
    if device.type == "cpu":
        return _CACHE_BYTES
    return min(_GPU_BYTES, _GPU_SHARE * torch.cuda.get_device_properties(device).total_memory)


class ParticleGS:
    """Renders the states of bound particles: ``images = particle_gs(x, F)``.

    Args:
        gaussians: static Gaussians at t = 0, G of them.
        binding: row-stochastic (G, N) binding matrix of Algorithm 1.
        x0: particle positions at t = 0 [m], shape (N, 3).
        cameras: V views.
        background: colour behind the Gaussians.
        covariance_gradient: propagate gradients to the particles through covariances too, not only means.
        affine: Gaussians follow the affine motion of their particles (`deform` with arms).
        eps2d: variance added to a splat by a pixel [px^2]; Gaussians of `fit_gaussians` already include it.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        binding: Binding,
        x0: Tensor,
        cameras: Cameras,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        covariance_gradient: bool = True,
        affine: bool = False,
        eps2d: float = 0.0,
    ):
        self.gaussians, self.binding, self.x0, self.cameras = gaussians, binding, x0, cameras
        self.covariance_gradient = covariance_gradient
        self._look = {"background": background, "eps2d": eps2d}
        with torch.no_grad():
            self._covars0 = gaussians.covars()
            self._sh = gaussians.sh()
            self._arms = arms_at_rest(gaussians.means, binding, x0) if affine else None

    def deformed(self, x: Tensor, F: Tensor) -> tuple[Tensor, Tensor]:
        """Means (T, G, 3) and covariances (T, G, 3, 3) for particle states x (T, N, 3) and F (T, N, 3, 3)."""
        at_rest = (self.gaussians.means, self._covars0, self.binding, self.x0)
        return deform(*at_rest, x, F, arms=self._arms, covariance_gradient=self.covariance_gradient)

    def __call__(self, x: Tensor, F: Tensor) -> Tensor:
        """Images (T, V, H, W, 3) in [0, 1] of the particle states x (T, N, 3) [m] and F (T, N, 3, 3)."""
        return self.splatted(*self.deformed(x, F))

    def splatted(self, means: Tensor, covars: Tensor) -> Tensor:
        """Images (T, V, H, W, 3) of deformed Gaussians, means (T, G, 3) [m] and covariances (T, G, 3, 3) [m^2]."""
        return self._rasterized(means, covars)[0]

    def coverage(self, x: Tensor, F: Tensor) -> Tensor:
        """Coverage of each pixel by the body, (T, V, H, W, 1) in [0, 1]."""
        return self._rasterized(*self.deformed(x, F))[1][..., None]

    def layer(self, x: Tensor, F: Tensor) -> Tensor:
        """Colours over the background, and coverage, (T, V, H, W, 4)."""
        colours, alpha = self._rasterized(*self.deformed(x, F))
        return torch.cat([colours, alpha[..., None]], dim=-1)

    def error(self, x: Tensor, F: Tensor, observed: Tensor) -> Tensor:
        """Mean squared difference (T,) of each frame's images from the observed ones (`rasterized_error`)."""
        return self.splatted_error(*self.deformed(x, F), observed)

    def splatted_error(self, means: Tensor, covars: Tensor, observed: Tensor) -> Tensor:
        """`error` of deformed Gaussians, with the arguments of `splatted`."""
        return rasterized_error(*self._arguments(means, covars), observed, **self._look)

    def _rasterized(self, means: Tensor, covars: Tensor) -> tuple[Tensor, Tensor]:
        return rasterize(*self._arguments(means, covars), **self._look)

    def _arguments(self, means: Tensor, covars: Tensor) -> tuple:
        views, opacities = self.cameras, self.gaussians.opacities
        return means, covars, opacities, self._sh, views.viewmats, views.Ks, views.width, views.height

    @property
    def frames_per_batch(self) -> int:
        """Number of frames to render together, estimated from the size of images and projected Gaussians."""
        return self._frames(14)

    @property
    def frames_per_error(self) -> int:
        """Number of frames to compute the `error` of together; a GPU does not store their images."""
        return self._frames(14 if self.x0.device.type == "cpu" else 5)

    def _frames(self, numbers: int) -> int:
        pixels = self.cameras.width * self.cameras.height
        per_view = (numbers * pixels + 60 * len(self.gaussians)) * self.x0.element_size()
        return max(1, int(_batch_bytes(self.x0.device) / (per_view * len(self.cameras))))

    def batches(self, x: Tensor, F: Tensor, size: int | None = None) -> Iterator[tuple[slice, Tensor]]:
        """Render ``size`` frames at a time (None: `frames_per_batch`): yields (slice of frames, images).

        States may be on another device than the Gaussians, to save memory.
        """
        size = size or self.frames_per_batch
        for start in range(0, len(x), size):
            part = slice(start, min(start + size, len(x)))
            yield part, self(x[part].to(self.x0), F[part].to(self.x0))
