"""Static Gaussian kernels from posed RGBA images (paper Sec. 3.1 and supplement, 3D Gaussian Splatting).

Start: points sampled in the visual hull of the alpha masks, coloured from the images. Loss: L1 and SSIM over
a random background, which makes alpha a fourth supervised channel, plus the anisotropy regulariser of
PhysGaussian. Kernels with large screen-space gradients are cloned or split up to a fixed number; transparent
ones are removed, at the end those with an opacity of at most 0.02, as in the paper.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from neuma_lib.config.gaussians import GaussiansConfig
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.geometry.visual_hull import Hull, visual_hull
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians, covariances, rotations
from neuma_lib.splatting.rasterizer import RenderBuffers, Statistics, rasterize
from neuma_lib.splatting.spherical_harmonics import coefficient_count, rgb_to_sh0

WHITE = (1.0, 1.0, 1.0)


@dataclass
class GaussianFitReport:
    """How a fit went.

    Attributes:
        losses: training loss of every iteration.
        count: kernels returned.
        culled: kernels removed by the final opacity cull.
        held_out: indices of the views kept for measurement.
        psnr: mean PSNR [dB] of the held-out views, full frame over white.
        psnr_object: the same inside the object (pixels with alpha above 1/2).
        train_psnr, train_psnr_object: of the views that were fitted.
    """

    losses: list[float]
    count: int
    culled: int
    held_out: list[int]
    psnr: float
    psnr_object: float
    train_psnr: float
    train_psnr_object: float


EPS2D = 0.3
"""Variance that a pixel adds to a splat during the fit [px^2], as usual in Gaussian splatting."""


def fit_gaussians(
    images: Tensor,
    cameras: Cameras,
    settings: GaussiansConfig,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> tuple[Gaussians, GaussianFitReport]:
    """Fit Gaussian kernels to images of an object.

    Args:
        images: (V, H, W, 4) RGBA with straight alpha in [0, 1]; alpha shows the object alone.
        cameras: their V cameras.
        settings: hyper-parameters.
        seed: of everything random; the same seed gives the same kernels on a CPU.
        progress: called with (iteration, loss) after each iteration.

    Returns:
        The kernels, without gradient and with the pixels' blur absorbed (render them with ``eps2d=0``), and a report.

    Raises:
        InputError: shapes disagree, or a mask is empty.
        NonFiniteError: the loss is not finite.
    """
    images = images.to(cameras.viewmats.dtype)
    _check(images, cameras)
    generator = torch.Generator().manual_seed(seed)
    held_out = (
        list(range(settings.held_out // 2, len(cameras), settings.held_out)) if settings.held_out else []
    )
    fitted = [i for i in range(len(cameras)) if i not in held_out]

    hull = visual_hull(images[fitted, ..., 3], cameras[fitted], settings.hull_resolution)
    start, spacing = _initial_gaussians(hull, images[fitted], cameras[fitted], settings, generator)
    kernels = _Kernels(start, spacing, settings)

    losses: list[float] = []
    order: list[int] = []
    rules = settings.densification
    first, last = round(rules.start * settings.iterations), round(rules.stop * settings.iterations)
    for iteration in range(settings.iterations):
        views = []
        for _ in range(settings.batch):
            if not order:
                order = [fitted[i] for i in torch.randperm(len(fitted), generator=generator).tolist()]
            views.append(order.pop())
        background = torch.rand(3, generator=generator).to(images)
        loss = kernels.step(images[views], cameras[views], background, iteration / settings.iterations)
        losses.append(loss)
        if not math.isfinite(loss):
            raise NonFiniteError(
                "gaussians", f"loss is {loss} in iteration {iteration}; lower the learning rates"
            )
        if first <= iteration < last and (iteration + 1) % rules.every == 0:
            kernels.densify(generator)
        if progress is not None:
            progress(iteration, loss)

    everything = kernels.gaussians()
    gaussians = everything.cull(settings.cull_opacity).absorbing_blur(cameras, EPS2D)
    psnr, psnr_object = evaluate(gaussians, images, cameras, held_out)
    train_psnr, train_psnr_object = evaluate(gaussians, images, cameras, fitted)
    report = GaussianFitReport(
        losses=losses,
        count=len(gaussians),
        culled=len(everything) - len(gaussians),
        held_out=held_out,
        psnr=psnr,
        psnr_object=psnr_object,
        train_psnr=train_psnr,
        train_psnr_object=train_psnr_object,
    )
    return gaussians, report


def evaluate(gaussians: Gaussians, images: Tensor, cameras: Cameras, views: list[int]) -> tuple[float, float]:
    """Mean PSNR [dB] over ``views`` against RGBA images over white: full frame; where alpha > 1/2."""
    if not views:
        return math.nan, math.nan
    full, inside = [], []
    covars, sh = gaussians.covars(), gaussians.sh()
    for view in views:
        camera = cameras[view]
        picture, _ = rasterize(
            gaussians.means[None], covars[None], gaussians.opacities, sh, camera.viewmats, camera.Ks,
            camera.width, camera.height, eps2d=0.0,
        )  # fmt: skip
        rgba = images[view]
        error = (picture[0, 0].clamp(0, 1) - (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:])) ** 2
        full.append(-10 * math.log10(float(error.mean())))
        inside.append(-10 * math.log10(float(error[rgba[..., 3] > 0.5].mean())))
    return sum(full) / len(full), sum(inside) / len(inside)


def _initial_gaussians(
    hull: Hull, images: Tensor, cameras: Cameras, settings: GaussiansConfig, generator: torch.Generator
) -> tuple[Gaussians, float]:
    """Isotropic kernels, most near the hull's surface, and their mean spacing [m]."""
    solid = hull.occupied.float()[None, None]
    eroded = -torch.nn.functional.max_pool3d(-torch.nn.functional.pad(solid, (1,) * 6), 3, stride=1)
    shell = hull.occupied & (eroded[0, 0] < 0.5)
    inner = hull.occupied & ~shell
    wanted_inside = round(settings.interior * settings.initial_count) if inner.any() else 0
    wanted = ((shell, settings.initial_count - wanted_inside), (inner, wanted_inside))
    # a shell voxel stands for about one voxel^2 of surface; spacings of a packed sheet and volume
    surface_spacing = hull.voxel * math.sqrt(1.15 * float(shell.sum()) / wanted[0][1])
    volume_spacing = hull.voxel * (1.41 * float(inner.sum()) / max(wanted_inside, 1)) ** (1 / 3)
    means, spacings = [], []
    for (voxels, count), spacing in zip(wanted, (surface_spacing, volume_spacing), strict=True):
        candidates = voxels.nonzero().to(hull.origin)
        if count == 0 or len(candidates) == 0:
            continue
        picked = _spread(candidates * hull.voxel, count, generator)
        jitter = torch.rand(len(picked), 3, generator=generator).to(hull.origin)
        means.append(hull.origin + (candidates[picked] + jitter) * hull.voxel)
        spacings.append(torch.full((len(picked),), spacing).to(hull.origin))
    means, spacing = torch.cat(means), torch.cat(spacings)
    count, higher = len(means), coefficient_count(settings.sh_degree) - 1
    identity = torch.zeros(count, 4).to(means)
    identity[:, 0] = 1
    gaussians = Gaussians(
        means=means,
        quats=identity,
        scales=(0.5 * spacing[:, None]).expand(-1, 3).clone(),
        opacities=torch.full_like(spacing, settings.initial_opacity),
        sh0=rgb_to_sh0(_mean_colours(means, images, cameras))[:, None],
        shN=torch.zeros(count, higher, 3).to(means),
    )
    return gaussians, surface_spacing


def _spread(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices of about ``count`` of the points, a random one of each cell of a grid with that many cells."""
    if count >= len(points):
        return torch.arange(len(points), device=points.device)
    low, high = 0.0, float((points.amax(0) - points.amin(0)).max())
    shuffled = torch.randperm(len(points), generator=generator).to(points.device)
    for _ in range(20):
        size = 0.5 * (low + high)
        cells = _cell_keys(points, size)
        low, high = (size, high) if len(torch.unique(cells)) > count else (low, size)
    cells = _cell_keys(points, high)[shuffled]
    order = torch.argsort(cells, stable=True)
    first = torch.ones_like(cells, dtype=torch.bool)
    first[1:] = cells[order][1:] != cells[order][:-1]
    return shuffled[order[first]]


def _cell_keys(points: Tensor, size: float) -> Tensor:
    """One integer a point that is equal for points in the same cube of side ``size``."""
    cells = ((points - points.amin(0)) / size).long()
    extent = cells.amax(0) + 1
    return (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]


def _mean_colours(points: Tensor, images: Tensor, cameras: Cameras) -> Tensor:
    """(P, 3) colour of each point averaged over the cameras that are nearest to looking straight at it."""
    pixels, depths = cameras.project(points)
    column = pixels[..., 0].floor().long().clamp(0, cameras.width - 1)
    row = pixels[..., 1].floor().long().clamp(0, cameras.height - 1)
    view = torch.arange(len(cameras), device=points.device)[:, None].expand_as(column)
    rgba = images[view, row, column]
    # a point on the surface is hidden from half of the cameras; those in front of it are the nearest
    weights = rgba[..., 3] * torch.softmax(-depths / (0.05 * depths.mean()), dim=0)
    return (weights[..., None] * rgba[..., :3]).sum(0) / weights.sum(0)[:, None].clamp_min(1e-6)


class _Kernels:
    """Parameters, their Adam state, and the rounds of densification."""

    def __init__(self, start: Gaussians, spacing: float, settings: GaussiansConfig):
        self.settings, self.spacing = settings, spacing
        self.parameters = {
            "means": start.means.clone(),
            "scales": start.scales.log(),
            "quats": start.quats.clone(),
            "opacities": torch.logit(start.opacities),
            "sh0": start.sh0.clone(),
            "shN": start.shN.clone(),
        }
        self.rates = {
            "means": settings.rate_means * spacing,
            "scales": settings.rate_scales,
            "quats": settings.rate_quats,
            "opacities": settings.rate_opacities,
            "sh0": settings.rate_colours,
            "shN": settings.rate_harmonics,
        }
        self.first_moments = {name: torch.zeros_like(value) for name, value in self.parameters.items()}
        self.second_moments = {name: torch.zeros_like(value) for name, value in self.parameters.items()}
        self.steps = 0
        self.buffers = RenderBuffers()
        self.statistics = Statistics()
        self._reset_statistics()

    def _reset_statistics(self) -> None:
        self.gradients = torch.zeros_like(self.parameters["opacities"])
        self.views = torch.zeros_like(self.parameters["opacities"])

    def gaussians(self) -> Gaussians:
        """The kernels as they are now."""
        p = self.parameters
        quats = torch.nn.functional.normalize(p["quats"], dim=-1)
        opacities = torch.sigmoid(p["opacities"])
        return Gaussians(
            p["means"].clone(), quats, p["scales"].exp(), opacities, p["sh0"].clone(), p["shN"].clone()
        )

    def step(self, images: Tensor, cameras: Cameras, background: Tensor, done: float) -> float:
        """One Adam step on (B, H, W, 4) images; ``done`` in [0, 1) is the part of the schedule behind us."""
        settings = self.settings
        leaves = {name: value.requires_grad_() for name, value in self.parameters.items() if value.numel()}
        pictures, _ = rasterize(
            leaves["means"][None],
            covariances(leaves["quats"], leaves["scales"].exp())[None],
            torch.sigmoid(leaves["opacities"]),
            torch.cat([leaves["sh0"], leaves["shN"]], dim=1) if "shN" in leaves else leaves["sh0"],
            cameras.viewmats,
            cameras.Ks,
            cameras.width,
            cameras.height,
            background=background,
            eps2d=EPS2D,
            statistics=self.statistics,
            buffers=self.buffers,
        )
        alpha = images[..., 3:]
        targets = images[..., :3] * alpha + (1 - alpha) * background
        loss = image_loss(pictures[0], targets, settings.ssim_weight)
        spread = leaves["scales"].amax(dim=1) - leaves["scales"].amin(dim=1)
        ratio = spread.clamp_min(math.log(settings.max_anisotropy)).exp()
        loss = loss + settings.anisotropy_weight * (ratio - settings.max_anisotropy).mean()
        gradients = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
        self.gradients += self.statistics.screen_gradients
        self.views += self.statistics.views
        with torch.no_grad():
            self._adam(gradients, done)
        return float(loss.detach())

    def _adam(self, gradients: dict[str, Tensor], done: float, beta1=0.9, beta2=0.99, eps=1e-15) -> None:
        self.steps += 1
        correction1, correction2 = 1 - beta1**self.steps, 1 - beta2**self.steps
        for name, gradient in gradients.items():
            value = self.parameters[name].requires_grad_(False)
            m, v = self.first_moments[name], self.second_moments[name]
            m.lerp_(gradient, 1 - beta1)
            v.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
            rate = self.rates[name] * (0.01 if name == "means" else 0.1) ** done
            value.addcdiv_(m, (v / correction2).sqrt_().add_(eps), value=-rate / correction1)
        low, high = (
            math.log(part * self.spacing) for part in (self.settings.min_scale, self.settings.max_scale)
        )
        self.parameters["scales"].clamp_(low, high)

    def densify(self, generator: torch.Generator) -> None:
        """Remove transparent kernels, then clone or split those whose screen-space gradients are largest."""
        rules = self.settings.densification
        score = self.gradients / self.views.clamp_min(1)
        keep = torch.sigmoid(self.parameters["opacities"]) > rules.min_opacity
        self._select(keep)
        score = score[keep]
        count = len(score)
        added = min(rules.max_count - count, int(rules.growth * count), int((score > 0).sum()))
        if added > 0:
            chosen = torch.sort(score, descending=True, stable=True).indices[:added]
            self._multiply(chosen, generator)
        self._reset_statistics()

    def _select(self, keep: Tensor) -> None:
        for table in (self.parameters, self.first_moments, self.second_moments):
            for name in table:
                table[name] = table[name][keep]

    def _multiply(self, chosen: Tensor, generator: torch.Generator) -> None:
        """Give each chosen kernel a twin; both shrink if it is large, else they share its alpha."""
        p = self.parameters
        scales = p["scales"][chosen].exp()
        large = scales.amax(dim=1) > self.settings.densification.split_scale * self.spacing * 0.5
        normal = torch.randn(len(chosen), 3, generator=generator).to(scales)
        offsets = (rotations(p["quats"][chosen]) @ (scales * normal)[..., None])[..., 0]
        offsets = torch.where(large[:, None], offsets, 0.5 * offsets)
        opacities = 1 - (1 - torch.sigmoid(p["opacities"][chosen])).sqrt()
        p["opacities"][chosen] = torch.where(large, p["opacities"][chosen], torch.logit(opacities))
        p["scales"][chosen] = torch.where(
            large[:, None], p["scales"][chosen] - math.log(1.6), p["scales"][chosen]
        )
        twins = {name: value[chosen] for name, value in p.items()}
        p["means"][chosen] -= 0.5 * offsets
        twins["means"] = twins["means"] + 0.5 * offsets
        for name in p:
            p[name] = torch.cat([p[name], twins[name]])
            for moments in (self.first_moments, self.second_moments):
                moments[name][chosen] = 0
                moments[name] = torch.cat([moments[name], torch.zeros_like(twins[name])])


def image_loss(pictures: Tensor, targets: Tensor, ssim_weight: float) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) of (B, H, W, 3) images, as in 3D Gaussian Splatting."""
    l1 = (pictures - targets).abs().mean()
    if ssim_weight == 0:
        return l1
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim_map(pictures, targets).mean())


def ssim_map(a: Tensor, b: Tensor, sigma: float = 1.5, radius: int = 5) -> Tensor:
    """SSIM (B, 3, H, W) of (B, H, W, 3) images in [0, 1]: 11 x 11 Gaussian window, zeros outside.

    The window is applied as two banded matrices, which one GEMM a side does faster than a small convolution.
    """
    a, b = (image.movedim(-1, 1) for image in (a, b))
    rows, columns = (_window(n, sigma, radius, a.dtype, a.device) for n in a.shape[-2:])
    maps = rows @ torch.stack([a, b, a * a, b * b, a * b]) @ columns.mT
    mean_a, mean_b, aa, bb, ab = maps
    product, squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    c1, c2 = 0.01**2, 0.03**2
    return (2 * product + c1) * (2 * (ab - product) + c2) / ((squares + c1) * (aa + bb - squares + c2))


@functools.lru_cache(maxsize=8)
def _window(size: int, sigma: float, radius: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    positions = torch.arange(size, dtype=torch.float64)
    offsets = positions[:, None] - positions
    weights = torch.exp(-(offsets**2) / (2 * sigma**2)) * (offsets.abs() <= radius)
    full = torch.exp(-(torch.arange(-radius, radius + 1, dtype=torch.float64) ** 2) / (2 * sigma**2)).sum()
    return (weights / full).to(device, dtype)


def _check(images: Tensor, cameras: Cameras) -> None:
    expected = (len(cameras), cameras.height, cameras.width, 4)
    if tuple(images.shape) != expected:
        raise InputError(
            f"gaussians: images have shape {tuple(images.shape)}, the cameras ask for {expected}"
        )
    empty = [i for i in range(len(images)) if not (images[i, ..., 3] > 0.5).any()]
    if empty:
        raise InputError(
            f"gaussians: the mask (alpha) of view {empty[0]} is empty; remove the view or mend its mask"
        )
