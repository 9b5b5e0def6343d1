"""Differentiable Gaussian splatting of a batch of frames (paper Sec. 3.3 and the supplement's 3DGS).

One autograd function contains projection and compositing, Warp kernels with hand-written adjoints. CPUs composite splat
by splat (``compositor_cpu``), GPUs tile by tile (``compositor_cuda``). If only the squared error is needed, the
compositor compares with the observation directly (``rasterized_error``).
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Literal

import torch

from neuma_lib.errors import InputError
from neuma_lib.splatting import compositor_cpu, compositor_cuda, projection
from neuma_lib.splatting.arrays import check_tensors
from neuma_lib.splatting.compositing import Settings
from neuma_lib.splatting.image_loss import as_integers, check_fits, mean_squared_error

Compositor = Literal["rows", "tiles"]
COMPOSITORS = {"rows": compositor_cpu, "tiles": compositor_cuda}


@dataclasses.dataclass
class Statistics:
    """Statistics of the last backward pass for densification and pruning.

    Attributes:
        screen_gradients: (G,) norm of the loss gradient with respect to the projected mean, in units of half
            the image (as in 3D Gaussian splatting), summed over the images.
        views: (G,) number of images in which the Gaussian is visible.
    """

    screen_gradients: torch.Tensor | None = None
    views: torch.Tensor | None = None


class RenderBuffers:
    """Memory reused between calls of the same shape, to save allocations and to allow CUDA graphs.

    A call overwrites the results of the previous one, so run backward before the next forward.
    """

    def __init__(self):
        self._buffers: dict[str, torch.Tensor] = {}

    def empty(self, name: str, shape: Sequence[int], like: torch.Tensor, dtype=None) -> torch.Tensor:
        dtype = dtype or like.dtype
        buffer = self._buffers.get(name)
        if buffer is None or buffer.shape != shape or buffer.dtype != dtype or buffer.device != like.device:
            buffer = self._buffers[name] = torch.empty(shape, dtype=dtype, device=like.device)
        return buffer


def _fresh(name: str, shape: Sequence[int], like: torch.Tensor, dtype=None) -> torch.Tensor:
    """Allocate for each call, so that results of several calls may coexist."""
    return torch.empty(shape, dtype=dtype or like.dtype, device=like.device)


@dataclasses.dataclass(frozen=True)
class _Options:
    settings: Settings
    compositor: ModuleType
    statistics: Statistics | None
    empty: Callable[..., torch.Tensor]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, covars, opacities, sh, viewmats, Ks, background, options: _Options):
        scene, seen = _project(means, covars, opacities, sh, viewmats, Ks, options)
        settings, empty = options.settings, options.empty
        pictures, alphas, kept = options.compositor.composite(*seen, background, settings, empty)
        ctx.save_for_backward(*scene, *seen, background, *kept)
        ctx.options = options
        shape = (len(means), len(viewmats), settings.height, settings.width)
        return pictures.view(*shape, 3), alphas.view(shape)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_pictures, grad_alphas):
        *_, splats, _, background = ctx.saved_tensors[:8]
        options, kept = ctx.options, ctx.saved_tensors[8:]
        size = (options.settings.height, options.settings.width)
        grad_pictures = grad_pictures.contiguous().view(-1, *size, 3)
        grad_alphas = grad_alphas.contiguous().view(-1, *size)
        grad_splats = options.empty("grad_splats", splats.shape, splats)
        options.compositor.composite_adjoint(
            splats, kept, background, options.settings, grad_pictures, grad_alphas, grad_splats, options.empty
        )
        return *_scene_gradients(ctx, grad_splats), None, None, None, None


class _RasterizedError(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, covars, opacities, sh, viewmats, Ks, background, observed, options: _Options):
        scene, seen = _project(means, covars, opacities, sh, viewmats, Ks, options)
        pixels = as_integers(observed).flatten(0, 1)
        sums, kept = options.compositor.compare(*seen, background, options.settings, pixels, options.empty)
        ctx.save_for_backward(*scene, *seen, background, *kept)
        ctx.options, ctx.channels = options, 3 * pixels.numel() // len(means)  # a frame's
        return (sums.view(len(means), -1).sum(1) / ctx.channels).to(means.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        *_, viewmats, _, splats, _, background = ctx.saved_tensors[:8]
        options, kept = ctx.options, ctx.saved_tensors[8:]
        scales = (grad * (2 / ctx.channels))[:, None].expand(-1, len(viewmats)).reshape(-1).contiguous()
        grad_splats = options.empty("grad_splats", splats.shape, splats)
        wanted = ctx.needs_input_grad[2]
        options.compositor.compare_adjoint(
            splats, kept, background, options.settings, scales, wanted, grad_splats
        )
        return *_scene_gradients(ctx, grad_splats), None, None, None, None, None


def _project(means, covars, opacities, sh, viewmats, Ks, options: _Options):
    """``(means, covars, sh, viewmats, Ks)`` in the memory layout of the kernels, and ``(splats, depths)``."""
    sh = projection.for_device(sh.detach())
    means, covars, opacities, viewmats, Ks = (
        x.detach().contiguous() for x in (means, covars, opacities, viewmats, Ks)
    )
    settings, empty = options.settings, options.empty
    seen = projection.project(means, covars, opacities, sh, viewmats, Ks, settings, empty)
    return (means, covars, sh, viewmats, Ks), seen


def _scene_gradients(ctx, grad_splats):
    """The required gradients of means, covars, opacities and sh, from tensors saved by `_project`."""
    means, covars, sh, viewmats, Ks, splats, depths = ctx.saved_tensors[:7]
    settings, statistics = ctx.options.settings, ctx.options.statistics
    if statistics is not None:
        visible = depths < projection.CULLED
        scaled = torch.stack(
            [grad_splats[..., 0] * (settings.width / 2), grad_splats[..., 1] * (settings.height / 2)], dim=-1
        )
        statistics.screen_gradients = torch.where(visible, scaled.norm(dim=-1), 0.0).sum(dim=0)
        statistics.views = visible.sum(dim=0)

    grad_means = grad_covars = grad_opacities = grad_sh = None
    seen = (splats, depths, grad_splats)
    if any(ctx.needs_input_grad[:2]):
        grad_means, grad_covars = projection.geometry_adjoint(
            means, covars, sh, viewmats, Ks, settings, *seen
        )
    if any(ctx.needs_input_grad[2:4]):
        grad_opacities, grad_sh = projection.appearance_adjoint(means, sh, viewmats, *seen)
    return grad_means, grad_covars, grad_opacities, grad_sh


def _own_compositor(means: torch.Tensor) -> Compositor:
    return "rows" if means.device.type == "cpu" else "tiles"


def _colour(background: Sequence[float] | torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    if isinstance(background, torch.Tensor):
        return background.detach().to(like).contiguous()
    return _constant(tuple(background), like.dtype, like.device)


@functools.lru_cache(maxsize=32)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Cached, because a copy to the GPU blocks the host."""
    return torch.tensor(values, dtype=dtype, device=device)


def check_shapes(means, covars, opacities, sh, viewmats, Ks) -> None:
    """Raise InputError unless the arguments of ``rasterize`` agree in shape, dtype and device."""
    T, G, V = means.shape[0], means.shape[1], viewmats.shape[0]
    expected = {
        "means": (means, (T, G, 3)),
        "covars": (covars, (T, G, 3, 3)),
        "opacities": (opacities, (G,)),
        "sh": (sh, (G, sh.shape[1] if sh.dim() == 3 else -1, 3)),
        "viewmats": (viewmats, (V, 4, 4)),
        "Ks": (Ks, (V, 3, 3)),
    }
    check_tensors("rasterize", expected)
    if means.dtype not in (torch.float32, torch.float64):
        raise InputError("rasterize: means", f"must be float32 or float64, not {means.dtype}")
    if sh.shape[1] not in (1, 4, 9, 16):
        raise InputError("rasterize: sh", f"must have 1, 4, 9 or 16 coefficients, not {sh.shape[1]}")


def rasterize(
    means: torch.Tensor,  # (T, G, 3) [m]
    covars: torch.Tensor,  # (T, G, 3, 3) [m^2]
    opacities: torch.Tensor,  # (G,) in (0, 1)
    sh: torch.Tensor,  # (G, K, 3)
    viewmats: torch.Tensor,  # (V, 4, 4) world to camera, OpenCV axes
    Ks: torch.Tensor,  # (V, 3, 3) [px]
    width: int,
    height: int,
    *,
    background: Sequence[float] | torch.Tensor = (1.0, 1.0, 1.0),
    alpha_min: float = 1.0 / 255.0,
    alpha_max: float = 0.99,
    transmittance_min: float = 1e-4,
    eps2d: float = 0.3,
    statistics: Statistics | None = None,
    buffers: RenderBuffers | None = None,
    compositor: Compositor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Render T frames from V cameras (paper Eq. 9).

    Differentiable with respect to ``means``, ``covars``, ``opacities`` and ``sh``. Contributions with alpha below
    ``alpha_min`` are ignored. Alpha is limited to ``alpha_max`` (without gradient). A pixel ends before the Gaussian
    that would reduce its transmittance below ``transmittance_min``. With alpha_min = 0, alpha_max > 1 and
    transmittance_min = 0 the image is a smooth function of its inputs, except for changes of the depth order.

    Args:
        means: Gaussian centres of every frame, world frame.
        covars: covariances of every frame; the symmetric part is used.
        opacities: shared by all frames.
        sh: colour coefficients shared by all frames; K = 1, 4, 9 or 16. Not rotated with the Gaussians.
        viewmats: camera poses.
        Ks: intrinsics without skew; pixel centres are at half integers.
        width, height: image size [px].
        background: colour behind the Gaussians, no gradient.
        alpha_min, alpha_max, transmittance_min: thresholds, see above.
        eps2d: blur added to the projected covariance [px^2].
        statistics: filled by the backward pass if given.
        buffers: memory reused between calls, which then contains the returned images.
        compositor: "rows" (CPU) or "tiles" (CUDA, float32).
            Default: rows on CPU, tiles on CUDA. Tiles synchronise once per call with
            the GPU, so they cannot be captured in a CUDA graph. In float64 on CUDA, the computation runs on the CPU,
            for comparisons only.

    Returns:
        images (T, V, H, W, 3) over ``background`` and alphas (T, V, H, W).

    Raises:
        InputError: inconsistent shapes, dtypes or devices, or ones that the compositor does not support.
    """
    check_shapes(means, covars, opacities, sh, viewmats, Ks)
    if means.is_cuda and means.dtype == torch.float64 and compositor is None:
        options = dict(
            background=background, alpha_min=alpha_min, alpha_max=alpha_max, transmittance_min=transmittance_min,
            eps2d=eps2d, statistics=statistics, buffers=buffers,
        )  # fmt: skip
        on_cpu = (tensor.cpu() for tensor in (means, covars, opacities, sh, viewmats, Ks))
        images, alphas = rasterize(*on_cpu, width, height, **options)
        return images.to(means.device), alphas.to(means.device)
    background = _colour(background, means)
    on_cpu, single = means.device.type == "cpu", means.dtype == torch.float32
    compositor = compositor or _own_compositor(means)
    works = {"rows": on_cpu, "tiles": not on_cpu and single}
    if not works.get(compositor, False):
        raise InputError(
            "rasterize: compositor",
            f"{compositor!r} does not support {means.dtype} on {means.device}",
            f"Choose {' or '.join(name for name, can in works.items() if can)}, or omit it",
        )
    thresholds = map(float, (alpha_min, alpha_max, transmittance_min, eps2d))
    settings = Settings(int(width), int(height), *thresholds)
    empty = _fresh if buffers is None else buffers.empty
    options = _Options(settings, COMPOSITORS[compositor], statistics, empty)
    return _Rasterize.apply(means, covars, opacities, sh, viewmats, Ks, background, options)


def rasterized_error(
    means: torch.Tensor,  # (T, G, 3) [m]
    covars: torch.Tensor,  # (T, G, 3, 3) [m^2]
    opacities: torch.Tensor,  # (G,) in (0, 1)
    sh: torch.Tensor,  # (G, K, 3)
    viewmats: torch.Tensor,  # (V, 4, 4)
    Ks: torch.Tensor,  # (V, 3, 3) [px]
    width: int,
    height: int,
    observed: torch.Tensor,  # (T, V, H, W, 4) uint8, or (T, V, H, W, 3)
    *,
    background: Sequence[float] | torch.Tensor = (1.0, 1.0, 1.0),
    alpha_min: float = 1.0 / 255.0,
    alpha_max: float = 0.99,
    transmittance_min: float = 1e-4,
    eps2d: float = 0.3,
) -> torch.Tensor:
    """Mean squared difference of each rendered frame from the observation (paper Eq. 2).

    Equals ``mean_squared_error(rasterize(...)[0], observed)`` and has the same gradients. For observations as uint8,
    the compositor computes it without storing images, with sums in another order (on CUDA in float32 only).

    Args:
        observed: see `mean_squared_error`.

    The others are those of `rasterize`.

    Returns:
        Mean over all views, pixels and channels of each frame, shape (T,).

    Raises:
        InputError: inconsistent shapes, dtypes or devices.
    """
    scene = (means, covars, opacities, sh, viewmats, Ks)
    thresholds = dict(
        alpha_min=alpha_min, alpha_max=alpha_max, transmittance_min=transmittance_min, eps2d=eps2d
    )
    compositor = COMPOSITORS[_own_compositor(means)]
    if observed.dtype != torch.uint8 or (means.is_cuda and means.dtype != torch.float32):
        images, _ = rasterize(*scene, width, height, background=background, **thresholds)
        return mean_squared_error(images, observed)
    check_shapes(*scene)
    check_fits((len(means), len(viewmats), height, width, 3), means.device, observed)
    settings = Settings(int(width), int(height), *map(float, thresholds.values()))
    options = _Options(settings, compositor, None, _fresh)
    return _RasterizedError.apply(*scene, _colour(background, means), observed, options)
