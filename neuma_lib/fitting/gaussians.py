"""Static Gaussians from posed RGBA images (paper Sec. 3.1 and supplement, 3D Gaussian Splatting).

Start: points sampled in the visual hull of the alpha masks, coloured from the images. Loss: L1 and SSIM over
a random background, which makes alpha a fourth supervised channel, plus the anisotropy regulariser of
PhysGaussian. Gaussians with large screen-space gradients are cloned or split up to a fixed number; transparent
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
from neuma_lib.geometry.visual_hull import Hull, check_masks, visual_hull
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians, covariances, rotations
from neuma_lib.splatting.rasterizer import RenderBuffers, Statistics, rasterize
from neuma_lib.splatting.spherical_harmonics import coefficient_count, rgb_to_sh0


@dataclass
class GaussianFitReport:
    """How a fit went.

    Attributes:
        losses: training loss of every iteration.
        count: Gaussians returned.
        culled: Gaussians removed by the final opacity cull.
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
_SHEET_PACKING = 1.15
"""Squared spacing over the area a point, hexagonally packed sheet: 2 / sqrt(3), rounded."""
_VOLUME_PACKING = 1.41
"""Cubed spacing over the volume a point, close packing of spheres: sqrt(2), rounded."""
_START_SCALE = 0.5
"""Standard deviation at the start over the spacing."""
_COLOUR_DEPTHS = 0.05
"""Depth [fraction of the mean depth] over which the weight of a farther camera falls by e in the first colours."""
_BETAS, _EPS = (0.9, 0.99), 1e-15
"""Adam's averaging factors and its smallest denominator (3DGS takes 0.9, 0.999; fits here are 20 times shorter)."""
_MEANS_DECAY, _RATE_DECAY = 0.01, 0.1
"""Last over first learning rate: of the centres (as 3DGS), of all else."""
_SPLIT_SHRINK = 1.6
"""Standard deviation of a Gaussian over those that it is split into, as in 3DGS."""
_CLONE_OFFSET = 0.5
"""Distance of a small Gaussian's clone over that of a large one's, both in random standard deviations."""


def fit_gaussians(
    images: Tensor,
    cameras: Cameras,
    settings: GaussiansConfig,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> tuple[Gaussians, GaussianFitReport]:
    """Fit Gaussians to images of an object.

    Args:
        images: (V, H, W, 4) RGBA with straight alpha in [0, 1]; alpha shows the object alone.
        cameras: their V cameras.
        settings: hyper-parameters.
        seed: of everything random; the same seed gives the same Gaussians on a CPU.
        progress: called with (iteration, loss) after each iteration.

    Returns:
        The Gaussians, without gradient and with the pixels' blur absorbed (render them with ``eps2d=0``), and a report.

    Raises:
        InputError: shapes disagree, a mask is empty or covers the frame, or masks and poses contradict each other.
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
    fit = _Fit(start, spacing, settings)

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
        loss = fit.step(images[views], cameras[views], background, iteration / settings.iterations)
        losses.append(loss)
        if not math.isfinite(loss):
            raise NonFiniteError(
                "gaussians", f"loss is {loss} in iteration {iteration}; lower the learning rates"
            )
        if first <= iteration < last and (iteration + 1) % rules.every == 0:
            fit.densify(generator)
        if progress is not None:
            progress(iteration, loss)

    everything = fit.gaussians()
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
    """Isotropic Gaussians, most near the hull's surface, and their mean spacing [m]."""
    solid = hull.occupied.float()[None, None]
    eroded = -torch.nn.functional.max_pool3d(-torch.nn.functional.pad(solid, (1,) * 6), 3, stride=1)
    shell = hull.occupied & (eroded[0, 0] < 0.5)
    inner = hull.occupied & ~shell
    wanted_inside = round(settings.interior * settings.initial_count) if inner.any() else 0
    wanted = ((shell, settings.initial_count - wanted_inside), (inner, wanted_inside))
    # a shell voxel stands for about one voxel^2 of surface
    surface_spacing = hull.voxel * math.sqrt(_SHEET_PACKING * float(shell.sum()) / wanted[0][1])
    volume_spacing = hull.voxel * (_VOLUME_PACKING * float(inner.sum()) / max(wanted_inside, 1)) ** (1 / 3)
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
        scales=(_START_SCALE * spacing[:, None]).expand(-1, 3).clone(),
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
    weights = rgba[..., 3] * torch.softmax(-depths / (_COLOUR_DEPTHS * depths.mean()), dim=0)
    return (weights[..., None] * rgba[..., :3]).sum(0) / weights.sum(0)[:, None].clamp_min(1e-6)


class _Fit:
    """Parameters of the Gaussians, the optimizer, and the rounds of densification."""

    def __init__(self, start: Gaussians, spacing: float, settings: GaussiansConfig):
        self.settings, self.spacing = settings, spacing
        parameters = {  # value at the start, learning rate, its decay
            "means": (start.means.clone(), settings.rate_means * spacing, _MEANS_DECAY),
            "scales": (start.scales.log(), settings.rate_scales, _RATE_DECAY),
            "quats": (start.quats.clone(), settings.rate_quats, _RATE_DECAY),
            "opacities": (torch.logit(start.opacities), settings.rate_opacities, _RATE_DECAY),
            "sh0": (start.sh0.clone(), settings.rate_colours, _RATE_DECAY),
            "shN": (start.shN.clone(), settings.rate_harmonics, _RATE_DECAY),
        }
        self.optimizer = torch.optim.Adam(
            [
                {"name": name, "params": [value.requires_grad_()], "first_lr": rate, "decay": decay}
                for name, (value, rate, decay) in parameters.items()
            ],
            betas=_BETAS,
            eps=_EPS,
        )
        self.buffers = RenderBuffers()
        self.statistics = Statistics()
        self._reset_statistics()

    def parameters(self) -> dict[str, Tensor]:
        """Means, log scales, quaternions, logits of the opacities, colours: leaves of the gradient."""
        return {group["name"]: group["params"][0] for group in self.optimizer.param_groups}

    def _reset_statistics(self) -> None:
        self.gradients = torch.zeros_like(self.parameters()["opacities"])
        self.views = torch.zeros_like(self.gradients)

    @torch.no_grad()
    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now."""
        p = self.parameters()
        quats = torch.nn.functional.normalize(p["quats"], dim=-1)
        opacities = torch.sigmoid(p["opacities"])
        return Gaussians(
            p["means"].clone(), quats, p["scales"].exp(), opacities, p["sh0"].clone(), p["shN"].clone()
        )

    def step(self, images: Tensor, cameras: Cameras, background: Tensor, done: float) -> float:
        """One Adam step on (B, H, W, 4) images; ``done`` in [0, 1) is the part of the schedule behind us."""
        settings, p = self.settings, self.parameters()
        pictures, _ = rasterize(
            p["means"][None],
            covariances(p["quats"], p["scales"].exp())[None],
            torch.sigmoid(p["opacities"]),
            torch.cat([p["sh0"], p["shN"]], dim=1),
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
        spread = p["scales"].amax(dim=1) - p["scales"].amin(dim=1)
        ratio = spread.clamp_min(math.log(settings.max_anisotropy)).exp()
        loss = loss + settings.anisotropy_weight * (ratio - settings.max_anisotropy).mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for group in self.optimizer.param_groups:
            group["lr"] = group["first_lr"] * group["decay"] ** done
        self.optimizer.step()
        low, high = (math.log(part * self.spacing) for part in (settings.min_scale, settings.max_scale))
        with torch.no_grad():
            p["scales"].clamp_(low, high)
        self.gradients += self.statistics.screen_gradients
        self.views += self.statistics.views
        return float(loss.detach())

    @torch.no_grad()
    def densify(self, generator: torch.Generator) -> None:
        """Remove transparent Gaussians, then clone or split those whose screen-space gradients are largest."""
        rules = self.settings.densification
        score = self.gradients / self.views.clamp_min(1)
        p = self.parameters()
        keep = torch.sigmoid(p["opacities"]) > rules.min_opacity
        self._replace({name: value[keep] for name, value in p.items()}, lambda moment: moment[keep])
        score = score[keep]
        count = len(score)
        added = min(rules.max_count - count, int(rules.growth * count), int((score > 0).sum()))
        if added > 0:
            chosen = torch.sort(score, descending=True, stable=True).indices[:added]
            self._multiply(chosen, generator)
        self._reset_statistics()

    def _replace(self, values: dict[str, Tensor], edit: Callable[[Tensor], Tensor]) -> None:
        """Put other values in the place of the parameters; ``edit`` makes their moments from the former ones."""
        for group in self.optimizer.param_groups:
            state = self.optimizer.state.pop(group["params"][0])
            state["exp_avg"], state["exp_avg_sq"] = edit(state["exp_avg"]), edit(state["exp_avg_sq"])
            group["params"] = [values[group["name"]].requires_grad_()]
            self.optimizer.state[group["params"][0]] = state

    def _multiply(self, chosen: Tensor, generator: torch.Generator) -> None:
        """Give each chosen Gaussian a twin; both shrink if it is large, else they share its alpha."""
        p = {name: value.clone() for name, value in self.parameters().items()}
        scales = p["scales"][chosen].exp()
        limit = self.settings.densification.split_scale * self.spacing * _START_SCALE
        large = scales.amax(dim=1) > limit
        normal = torch.randn(len(chosen), 3, generator=generator).to(scales)
        offsets = (rotations(p["quats"][chosen]) @ (scales * normal)[..., None])[..., 0]
        offsets = torch.where(large[:, None], offsets, _CLONE_OFFSET * offsets)
        opacities = 1 - (1 - torch.sigmoid(p["opacities"][chosen])).sqrt()
        p["opacities"][chosen] = torch.where(large, p["opacities"][chosen], torch.logit(opacities))
        p["scales"][chosen] = torch.where(
            large[:, None], p["scales"][chosen] - math.log(_SPLIT_SHRINK), p["scales"][chosen]
        )
        twins = {name: value[chosen] for name, value in p.items()}
        p["means"][chosen] -= 0.5 * offsets
        twins["means"] = twins["means"] + 0.5 * offsets

        def edit(moment: Tensor) -> Tensor:
            """Both twins start without a past."""
            moment[chosen] = 0
            return torch.cat([moment, torch.zeros_like(moment[chosen])])

        self._replace({name: torch.cat([p[name], twins[name]]) for name in p}, edit)


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
    check_masks(images[..., 3])
