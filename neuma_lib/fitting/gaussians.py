"""Static Gaussians from posed RGBA images (paper Sec. 3.1 and supplement, 3D Gaussian Splatting).

Initialisation: points sampled in the visual hull of the alpha masks, with colours from the images. Loss: L1 and SSIM
over a random background, which supervises alpha as a fourth channel, and the anisotropy regulariser of PhysGaussian.
Gaussians with large screen-space gradients are cloned or split up to a maximum number. Transparent ones are removed, at
the end those with an opacity of at most 0.02, as in the paper.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neuma_lib.config.gaussians import GaussiansConfig
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.image_quality import image_loss, mean_psnr
from neuma_lib.fitting.initial_gaussians import START_SCALE, initial_gaussians
from neuma_lib.geometry.visual_hull import check_masks, visual_hull
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians, covariances, rotations
from neuma_lib.splatting.rasterizer import RenderBuffers, Statistics, rasterize
from neuma_lib.splatting.spherical_harmonics import SH_C0


@dataclass
class GaussianFitReport:
    """Report of a fit.

    Attributes:
        losses: training loss of every iteration.
        count: number of Gaussians.
        culled: number of Gaussians removed by the final opacity cull.
        held_out: indices of the held-out views.
        psnr: mean PSNR [dB] of the held-out views, full frame over white.
        psnr_object: the same inside the object (pixels with alpha above 1/2).
        train_psnr, train_psnr_object: the same for the training views.
        gains: red, green and blue exposure of each view, or None if not fitted. Those of the training views have a
            geometric mean of 1. Those of the held-out views are least-squares fits to the render, because the exposure
            of a photograph is otherwise unknown, and are applied in the measures.
    """

    losses: list[float]
    count: int
    culled: int
    held_out: list[int]
    psnr: float
    psnr_object: float
    train_psnr: float
    train_psnr_object: float
    gains: list[list[float]] | None = None


EPS2D = 0.3
"""Variance that a pixel adds to a splat during the fit [px^2], as usual in Gaussian splatting."""
_BETAS, _EPS = (0.9, 0.99), 1e-15
"""Betas and epsilon of Adam (3DGS uses 0.9, 0.999, but fits here are 20 times shorter)."""
_MEANS_DECAY, _RATE_DECAY = 0.01, 0.1
"""Ratio of last to first learning rate for centres (as in 3DGS) and for all other parameters."""
_SPLIT_SHRINK = 1.6  # ratio of the standard deviations of a Gaussian before and after a split, as in 3DGS
_CLONE_OFFSET = 0.5  # ratio of the offset of a clone to that of a split


def fit_gaussians(
    images: Tensor | Sequence[Tensor],
    cameras: Cameras | Sequence[Cameras],
    settings: GaussiansConfig,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
    floor: float | None = None,
    gain_rate: float = 0.0,
) -> tuple[Gaussians, GaussianFitReport]:
    """Fit Gaussians to images of an object.

    Args:
        images: V RGBA images with straight alpha in [0, 1], shape (H, W, 4) each. Alpha is the object mask.
        cameras: their V cameras, or V sets of one camera if sizes differ.
        settings: hyper-parameters.
        seed: random seed; the same seed gives the same Gaussians on a CPU.
        progress: called with (iteration, loss) after each iteration.
        floor: height y of the floor [m], below which no Gaussian is initialised, or None.
        gain_rate: learning rate of the logarithms of the exposures per view and channel; 0 for equal exposures.

    Returns:
        The Gaussians, without gradient and including the blur of pixels (render them with ``eps2d=0``), and a report.

    Raises:
        InputError: shapes do not match, a mask is empty or covers the frame, or masks and poses are inconsistent.
        NonFiniteError: the loss is not finite.
    """
    views = _Views.of(images, cameras)
    count = len(views.cameras)
    generator = torch.Generator().manual_seed(seed)
    held_out = list(range(settings.held_out // 2, count, settings.held_out)) if settings.held_out else []
    fitted = [i for i in range(count) if i not in held_out]

    training = views.select(fitted)
    hull = visual_hull(training.masks(), training.cameras, settings.hull_resolution, floor)
    start, spacing = initial_gaussians(hull, training.images, training.cameras, settings, generator)
    gains = _Gains(fitted, count, gain_rate, start.means) if gain_rate else None
    fit = _Fit(start, spacing, settings, gains)

    losses: list[float] = []
    order: list[int] = []
    rounds = settings.densification
    first, last = round(rounds.start * settings.iterations), round(rounds.stop * settings.iterations)
    for iteration in range(settings.iterations):
        batch = []
        for _ in range(settings.batch):
            if not order:
                order = [fitted[i] for i in torch.randperm(len(fitted), generator=generator).tolist()]
            batch.append(order.pop())
        background = torch.rand(3, generator=generator).to(start.means)
        loss = fit.step(views, batch, background, iteration / settings.iterations)
        losses.append(loss)
        if not math.isfinite(loss):
            problem = f"the loss is {loss} in iteration {iteration}. Lower the learning rates"
            raise NonFiniteError("gaussians", problem)
        if first <= iteration < last and (iteration + 1) % rounds.every == 0:
            fit.densify(generator)
        if progress is not None:
            progress(iteration, loss)

    everything = fit.gaussians()
    gaussians = everything.cull(settings.cull_opacity).absorbing_blur(Cameras.joined(views.cameras), EPS2D)
    exposures = gains.values() if gains else None
    for view in held_out if gains else ():
        exposures[view] = _exposure(gaussians, views, view)
    psnr, psnr_object = _evaluate(gaussians, views, held_out, exposures)
    train_psnr, train_psnr_object = _evaluate(gaussians, views, fitted, exposures)
    report = GaussianFitReport(
        losses=losses,
        count=len(gaussians),
        culled=len(everything) - len(gaussians),
        held_out=held_out,
        psnr=psnr,
        psnr_object=psnr_object,
        train_psnr=train_psnr,
        train_psnr_object=train_psnr_object,
        gains=exposures.tolist() if gains else None,
    )
    return gaussians, report


@dataclass(frozen=True, eq=False)
class _Views:
    """Images and their cameras: a tensor (V, H, W, 4) and V cameras, or lists of V of each if sizes differ."""

    images: Tensor | list[Tensor]
    cameras: Cameras | list[Cameras]

    @classmethod
    def of(cls, images: Tensor | Sequence[Tensor], cameras: Cameras | Sequence[Cameras]) -> "_Views":
        """Checked views. Raises InputError if shapes do not match or a mask has no outline."""
        if isinstance(images, Tensor) and isinstance(cameras, Cameras):
            images = images.to(cameras.viewmats.dtype)
            shape, expected = tuple(images.shape), (len(cameras), cameras.height, cameras.width, 4)
        else:
            cameras = list(cameras)
            images = [image.to(camera.viewmats.dtype) for image, camera in zip(images, cameras, strict=True)]
            shape = [tuple(image.shape) for image in images]
            expected = [(camera.height, camera.width, 4) for camera in cameras]
        if shape != expected:
            raise InputError("images", f"shape {shape} must be {expected}, as for the cameras")
        views = cls(images, cameras)
        check_masks(views.masks())
        return views

    def select(self, views: list[int]) -> "_Views":
        if isinstance(self.cameras, Cameras):
            return _Views(self.images[views], self.cameras[views])
        return _Views([self.images[i] for i in views], [self.cameras[i] for i in views])

    def masks(self) -> Tensor | list[Tensor]:
        """Alpha of each view."""
        return self.images[..., 3] if isinstance(self.images, Tensor) else [i[..., 3] for i in self.images]

    def batches(self, views: list[int], alone: bool) -> list[tuple[list[int], Tensor, Cameras]]:
        """Indices, images (B, H, W, 4) and cameras of views that are rendered together, or one by one if ``alone``."""
        if isinstance(self.cameras, Cameras) and not alone:
            return [(views, self.images[views], self.cameras[views])]
        return [([i], self.images[i][None], self.cameras[i]) for i in views]


class _Gains:
    """Exposure and white balance of each view relative to the mean of the training views, one factor per channel."""

    def __init__(self, fitted: list[int], count: int, rate: float, like: Tensor):
        self.fitted, self.rate = fitted, rate
        self.logarithms = torch.zeros(count, 3).to(like).requires_grad_()
        self.optimizer = torch.optim.Adam([self.logarithms], betas=_BETAS, eps=_EPS)

    def of(self, view: int) -> Tensor:
        """Gain (3,), differentiable, without the mean, which is equivalent to brighter Gaussians."""
        return (self.logarithms[view] - self.logarithms[self.fitted].mean(dim=0)).exp()

    def step(self, done: float) -> None:
        self.optimizer.param_groups[0]["lr"] = self.rate * _RATE_DECAY**done
        self.optimizer.step()

    @torch.no_grad()
    def values(self) -> Tensor:
        """Gains (V, 3), defined only for training views."""
        return torch.stack([self.of(view) for view in range(len(self.logarithms))])


def _exposed(sh: Tensor, gain: Tensor) -> Tensor:
    """Coefficients (G, K, 3) of colours multiplied by ``gain`` (3,). A colour is 0.5 + sum of harmonics."""
    scaled = sh * gain
    return torch.cat([scaled[:, :1] + 0.5 * (gain - 1) / SH_C0, scaled[:, 1:]], dim=1)


def render_over_white(gaussians: Gaussians, sh: Tensor, camera: Cameras) -> tuple[Tensor, Tensor]:
    """Image over white (H, W, 3) and its alpha (H, W)."""
    pictures, alphas = rasterize(
        gaussians.means[None], gaussians.covars()[None], gaussians.opacities, sh, camera.viewmats, camera.Ks,
        camera.width, camera.height, eps2d=0.0,
    )  # fmt: skip
    return pictures[0, 0], alphas[0, 0]


def _exposure(gaussians: Gaussians, views: _Views, view: int) -> Tensor:
    """Least-squares gain (3,) between the render and an image inside the object."""
    picture, alpha = render_over_white(gaussians, gaussians.sh(), views.cameras[view])
    rgba = views.images[view]
    inside = rgba[..., 3] > 0.5
    colour, target = (picture - (1 - alpha[..., None]))[inside], (rgba[..., :3] * rgba[..., 3:])[inside]
    return (colour * target).sum(dim=0) / colour.square().sum(dim=0).clamp_min(_EPS)


def _evaluate(
    gaussians: Gaussians, views: _Views, chosen: list[int], exposures: Tensor | None
) -> tuple[float, float]:
    """Mean PSNR [dB] over chosen views with respect to RGBA images over white: full frame, and where alpha > 1/2."""
    sh = gaussians.sh()

    def error(view: int) -> tuple[Tensor, Tensor]:
        exposed = sh if exposures is None else _exposed(sh, exposures[view])
        picture, _ = render_over_white(gaussians, exposed, views.cameras[view])
        rgba = views.images[view]
        white = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
        return (picture.clamp(0, 1) - white) ** 2, rgba[..., 3]

    return mean_psnr(map(error, chosen))  # one view at a time in memory


class _Fit:
    """Parameters of the Gaussians, optimizer, and densification."""

    def __init__(self, start: Gaussians, spacing: float, settings: GaussiansConfig, gains: _Gains | None):
        self.settings, self.spacing, self.gains = settings, spacing, gains
        parameters = {  # initial value, learning rate, its decay
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
        """Means, log scales, quaternions, logits of the opacities and colours, as leaves."""
        return {group["name"]: group["params"][0] for group in self.optimizer.param_groups}

    def _reset_statistics(self) -> None:
        self.gradients = torch.zeros_like(self.parameters()["opacities"])
        self.views = torch.zeros_like(self.gradients)

    @torch.no_grad()
    def gaussians(self) -> Gaussians:
        """The current Gaussians."""
        p = self.parameters()
        quats = torch.nn.functional.normalize(p["quats"], dim=-1)
        opacities = torch.sigmoid(p["opacities"])
        return Gaussians(
            p["means"].clone(), quats, p["scales"].exp(), opacities, p["sh0"].clone(), p["shN"].clone()
        )

    def step(self, views: _Views, batch: list[int], background: Tensor, done: float) -> float:
        """One Adam step on a batch of views; ``done`` in [0, 1) is the position in the schedule."""
        self.optimizer.zero_grad(set_to_none=True)
        if self.gains:
            self.gains.optimizer.zero_grad(set_to_none=True)
        total = 0.0
        for chosen, images, cameras in views.batches(batch, alone=self.gains is not None):
            loss = self._loss(images, cameras, background, self.gains.of(chosen[0]) if self.gains else None)
            share = len(chosen) / len(batch)
            (share * loss).backward()
            total += share * float(loss.detach())
            self.gradients += self.statistics.screen_gradients
            self.views += self.statistics.views
        for group in self.optimizer.param_groups:
            group["lr"] = group["first_lr"] * group["decay"] ** done
        self.optimizer.step()
        if self.gains:
            self.gains.step(done)
        p = self.parameters()
        low, high = (
            math.log(part * self.spacing) for part in (self.settings.min_scale, self.settings.max_scale)
        )
        with torch.no_grad():
            p["scales"].clamp_(low, high)
        return total

    def _loss(self, images: Tensor, cameras: Cameras, background: Tensor, gain: Tensor | None) -> Tensor:
        """Loss of images (B, H, W, 4) with a common gain, if any."""
        settings, p = self.settings, self.parameters()
        sh = torch.cat([p["sh0"], p["shN"]], dim=1)
        pictures, _ = rasterize(
            p["means"][None],
            covariances(p["quats"], p["scales"].exp())[None],
            torch.sigmoid(p["opacities"]),
            sh if gain is None else _exposed(sh, gain),
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
        return loss + settings.anisotropy_weight * (ratio - settings.max_anisotropy).mean()

    @torch.no_grad()
    def densify(self, generator: torch.Generator) -> None:
        """Remove transparent Gaussians, then clone or split those with the largest screen-space gradients."""
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
        """Replace the values of the parameters. ``edit`` maps the old moments of Adam to the new ones."""
        for group in self.optimizer.param_groups:
            state = self.optimizer.state.pop(group["params"][0])
            state["exp_avg"], state["exp_avg_sq"] = edit(state["exp_avg"]), edit(state["exp_avg_sq"])
            group["params"] = [values[group["name"]].requires_grad_()]
            self.optimizer.state[group["params"][0]] = state

    def _multiply(self, chosen: Tensor, generator: torch.Generator) -> None:
        """Duplicate each chosen Gaussian. Large ones are shrunk, small ones share the alpha."""
        p = {name: value.clone() for name, value in self.parameters().items()}
        scales = p["scales"][chosen].exp()
        limit = self.settings.densification.split_scale * self.spacing * START_SCALE
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
            """Both copies start with zero moments."""
            moment[chosen] = 0
            return torch.cat([moment, torch.zeros_like(moment[chosen])])

        self._replace({name: torch.cat([p[name], twins[name]]) for name in p}, edit)
