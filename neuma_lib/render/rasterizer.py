"""Differentiable Gaussian splatting of a batch of frames (paper Sec. 3.3 and the supplement's 3DGS).

One autograd function holds the whole render: projection, depth order and compositing, each a Warp kernel with
a hand-written adjoint. A CPU composites splat by splat (``splat_rows``), a GPU pixel by pixel
(``splat_pixels``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
import warp as wp

from neuma_lib import warp_setup
from neuma_lib.errors import InputError
from neuma_lib.render import projection, splat_pixels, splat_rows


@dataclasses.dataclass
class Statistics:
    """What the last backward pass saw of every Gaussian, for densification and pruning.

    Attributes:
        screen_gradients: (G,) norm of the loss gradient with respect to the projected mean, in units of half
            the image (as in 3D Gaussian splatting), summed over the images.
        views: (G,) number of images in which the Gaussian took part.
    """

    screen_gradients: torch.Tensor | None = None
    views: torch.Tensor | None = None


class Workspace:
    """Buffers kept between calls of the same shape, so that a loop allocates little and can be captured.

    A call overwrites what the call before it left: with a workspace, run backward before the next forward.
    """

    def __init__(self):
        self._buffers: dict[str, torch.Tensor] = {}

    def empty(self, name: str, shape: Sequence[int], like: torch.Tensor, dtype=None) -> torch.Tensor:
        dtype = dtype or like.dtype
        buffer = self._buffers.get(name)
        if buffer is None or buffer.shape != shape or buffer.dtype != dtype or buffer.device != like.device:
            buffer = self._buffers[name] = torch.empty(shape, dtype=dtype, device=like.device)
        return buffer


class _FreshBuffers:
    """Allocates every time: results of several calls may be alive together."""

    def empty(self, name: str, shape: Sequence[int], like: torch.Tensor, dtype=None) -> torch.Tensor:
        return torch.empty(shape, dtype=dtype or like.dtype, device=like.device)


@dataclasses.dataclass(frozen=True)
class _Options:
    width: int
    height: int
    alpha_min: float
    alpha_max: float
    transmittance_min: float
    eps2d: float
    pixel_major: bool
    statistics: Statistics | None
    buffers: Workspace | _FreshBuffers


def _vectors(tensor: torch.Tensor) -> wp.array:
    """(..., 3) tensor as an array of vectors."""
    real = wp.dtype_from_torch(tensor.dtype)
    return wp.from_torch(tensor, dtype=wp.types.vector(3, real), requires_grad=False)


def _matrices(tensor: torch.Tensor) -> wp.array:
    """(..., n, n) tensor as an array of matrices."""
    real = wp.dtype_from_torch(tensor.dtype)
    size = tensor.shape[-1]
    return wp.from_torch(tensor, dtype=wp.types.matrix((size, size), real), requires_grad=False)


def _plain(tensor: torch.Tensor) -> wp.array:
    return wp.from_torch(tensor, requires_grad=False)


def _launch_target(device: torch.device) -> dict:
    return {"device": wp.device_from_torch(device), "stream": warp_setup.stream(device)}


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, covars, opacities, sh, viewmats, Ks, background, options: _Options):
        T, G, V = means.shape[0], means.shape[1], viewmats.shape[0]
        images, height, width = T * V, options.height, options.width
        inputs = tuple(
            x.detach().contiguous() for x in (means, covars, opacities, sh, viewmats, Ks, background)
        )
        means, covars, opacities, sh, viewmats, Ks, background = inputs
        launch = _launch_target(means.device)
        empty = options.buffers.empty

        splats = empty("splats", (images, G, projection.SPLAT_SIZE), means)
        depths = empty("depths", (images, G), means)
        project, _ = projection.kernels(means.dtype)
        wp.launch(
            project,
            dim=(images, G),
            inputs=[
                _vectors(means), _matrices(covars), _plain(opacities), _vectors(sh), _matrices(viewmats),
                _matrices(Ks), float(width), float(height), options.eps2d, options.alpha_min,
            ],
            outputs=[_plain(splats), _plain(depths)],
            **launch,
        )  # fmt: skip
        order = torch.argsort(depths, dim=1, stable=True)
        seen = (depths < projection.CULLED).sum(dim=1)

        pictures = empty("pictures", (images, height, width, 3), means)
        alphas = empty("alphas", (images, height, width), means)
        common = [_plain(splats), _plain(order), _plain(seen)]
        thresholds = [options.alpha_min, options.alpha_max, options.transmittance_min]
        if options.pixel_major:
            composite, _ = splat_pixels.kernels(means.dtype)
            remains = (
                empty("transmittances", (images, height, width), means),
                empty("stops", (images, height, width), means, torch.int32),
            )
            dim, outputs = (images, height, width), [_plain(pictures), _plain(alphas), *map(_plain, remains)]
        else:
            composite, _ = splat_rows.kernels(means.dtype)
            pitch = splat_rows.padded_width(width)
            remains = (empty("planes", (images, splat_rows.FORWARD_PLANES, height, pitch), means),)
            dim, outputs = images, [_plain(remains[0]), _plain(pictures), _plain(alphas)]
        wp.launch(
            composite, dim=dim, inputs=[*common, *thresholds, _plain(background)], outputs=outputs, **launch
        )

        ctx.save_for_backward(
            means, covars, sh, viewmats, Ks, background, splats, depths, order, seen, *remains
        )
        ctx.options = options
        return pictures.view(T, V, height, width, 3), alphas.view(T, V, height, width)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_pictures, grad_alphas):
        means, covars, sh, viewmats, Ks, background, splats, depths, order, seen, *remains = ctx.saved_tensors
        options: _Options = ctx.options
        images, G = depths.shape
        height, width = options.height, options.width
        launch = _launch_target(means.device)
        empty = options.buffers.empty
        grad_pictures = grad_pictures.contiguous().view(images, height, width, 3)
        grad_alphas = grad_alphas.contiguous().view(images, height, width)

        grad_splats = empty("grad_splats", splats.shape, means)
        grads = [_plain(grad_pictures), _plain(grad_alphas)]
        order_arguments = [_plain(splats), _plain(order)]
        thresholds = [options.alpha_min, options.alpha_max]
        if options.pixel_major:
            grad_splats.zero_()
            _, composite_adjoint = splat_pixels.kernels(means.dtype)
            dim = (images, height, width)
            inputs = [*order_arguments, *thresholds, _plain(background), *map(_plain, remains), *grads]
            outputs = [_plain(grad_splats)]
        else:
            _, composite_adjoint = splat_rows.kernels(means.dtype)
            dim = images
            inputs = [
                *order_arguments, _plain(seen), *thresholds, _plain(background), _plain(remains[0]), *grads
            ]  # fmt: skip
            scratch = empty("scratch", (images, splat_rows.BACKWARD_PLANES, *remains[0].shape[2:]), means)
            outputs = [_plain(scratch), _plain(grad_splats)]
        wp.launch(composite_adjoint, dim=dim, inputs=inputs, outputs=outputs, **launch)

        if options.statistics is not None:
            visible = depths < projection.CULLED
            scale = torch.tensor([width / 2, height / 2], dtype=means.dtype, device=means.device)
            norms = torch.where(visible, (grad_splats[..., :2] * scale).norm(dim=-1), 0.0)
            options.statistics.screen_gradients = norms.sum(dim=0)
            options.statistics.views = visible.sum(dim=0)

        grad_means = torch.empty_like(means)
        grad_covars = torch.empty_like(covars)
        grad_opacities = means.new_empty(G)
        grad_sh = torch.empty_like(sh)
        _, project_adjoint = projection.kernels(means.dtype)
        wp.launch(
            project_adjoint,
            dim=G,
            inputs=[
                _vectors(means), _matrices(covars), _vectors(sh), _matrices(viewmats), _matrices(Ks),
                float(width), float(height), _plain(splats), _plain(depths), _plain(grad_splats),
            ],
            outputs=[_vectors(grad_means), _matrices(grad_covars), _plain(grad_opacities), _vectors(grad_sh)],
            **launch,
        )  # fmt: skip
        return grad_means, grad_covars, grad_opacities, grad_sh, None, None, None, None


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
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise InputError(f"rasterize: {name} has shape {tuple(tensor.shape)}, expected {shape}")
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise InputError(
                f"rasterize: {name} is {tensor.dtype} on {tensor.device}, "
                f"means are {means.dtype} on {means.device}"
            )
    if means.dtype not in (torch.float32, torch.float64):
        raise InputError(f"rasterize: dtype {means.dtype} is not supported, use float32 or float64")
    if sh.shape[1] not in (1, 4, 9, 16):
        raise InputError(f"rasterize: sh has {sh.shape[1]} coefficients a channel, expected 1, 4, 9 or 16")


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
    workspace: Workspace | None = None,
    pixel_major: bool | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Render T frames from V cameras.

    Differentiable with respect to ``means``, ``covars``, ``opacities`` and ``sh``. A contribution counts
    where its alpha is at least ``alpha_min``; alpha is limited to ``alpha_max`` (no gradient where it is); a
    pixel ends before the Gaussian that would bring its transmittance below ``transmittance_min``. With
    alpha_min = 0, alpha_max > 1 and transmittance_min = 0 the image is a smooth function of its inputs, apart
    from the order in depth.

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
        statistics: filled by the backward pass when given.
        workspace: keeps buffers between calls; the images returned then live in it.
        pixel_major: choose the compositing kernels; default: pixel by pixel on CUDA, splat by splat on CPU.

    Returns:
        images (T, V, H, W, 3) over ``background`` and alphas (T, V, H, W).

    Raises:
        InputError: shapes, dtypes or devices disagree.
    """
    check_shapes(means, covars, opacities, sh, viewmats, Ks)
    on_cpu = means.device.type == "cpu"
    pixel_major = not on_cpu if pixel_major is None else pixel_major
    if not pixel_major and not on_cpu:
        raise InputError("rasterize: pixel_major=False is for CPU tensors only")
    options = _Options(
        int(width),
        int(height),
        float(alpha_min),
        float(alpha_max),
        float(transmittance_min),
        float(eps2d),
        pixel_major,
        statistics,
        workspace if workspace is not None else _FreshBuffers(),
    )
    background = torch.as_tensor(background, dtype=means.dtype, device=means.device)
    return _Rasterize.apply(means, covars, opacities, sh, viewmats, Ks, background, options)
