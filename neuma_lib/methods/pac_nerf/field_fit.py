"""Voxel radiance field from posed RGBA images: the first stage of PAC-NeRF (Li et al. 2023, Sec. 3.1).

The field is rendered as in the later stages: its densities and features are transferred to particles and back to the
nodes before rendering, so that it is trained for this round trip. At given iterations the voxel is halved, the lattice
is restricted to occupied nodes, and Adam restarts.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.image_quality import mean_psnr
from neuma_lib.geometry.visual_hull import Hull, check_masks, visual_hull
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.methods.pac_nerf.field import FieldParticles, RadianceField
from neuma_lib.methods.pac_nerf.field_options import RadianceConfig
from neuma_lib.methods.pac_nerf.lattice import Lattice
from neuma_lib.methods.pac_nerf.rendering import Opacity, camera_rays
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.observation import over_white

VOLUME_RANGE = (1e-4, 1e-1)  # range of opacities in the volume term (PAC-NeRF)
CERTAIN = 1e-5  # minimum distance of transmittances from 0 and 1 in their entropy (PAC-NeRF)


@dataclass
class RadianceReport:
    """Report of a fit."""

    losses: list[float]  # training loss of every iteration
    voxel: float  # voxel of the last lattice [m]
    nodes: tuple[int, int, int]  # nodes of the last lattice along each axis
    particles: int  # number of particles of the final field
    held_out: list[int]  # indices of the held-out views
    # psnr, psnr_object: mean PSNR [dB] of the held-out views rendered with particles, full frame over white
    # and inside the object (pixels with alpha above 1/2)
    psnr: float
    psnr_object: float
    # direct_psnr, direct_psnr_object: the same without particles
    direct_psnr: float
    direct_psnr_object: float


def fit_radiance_field(
    images: Tensor,
    cameras: Cameras,
    settings: RadianceConfig,
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> tuple[RadianceField, RadianceReport]:
    """Fit a field to images of an object, initially in the bounding box of its visual hull.

    Args:
        images: RGBA (V, H, W, 4) with straight alpha in [0, 1].
        cameras: their V cameras, more than half of `settings.held_out`.
        seed: random seed; the same seed gives the same field on a CPU.
        checkpoint: file for the state, so that an interrupted fit can resume; None for none.
        progress: called with (iteration, loss) after each iteration.

    Raises:
        InputError: shapes do not match, a mask is empty or covers the frame, or masks and poses are inconsistent.
        NonFiniteError: the loss is not finite.
    """
    _check(images, cameras, settings.held_out)
    images = images.to(cameras.viewmats.dtype)
    held_out = list(range(settings.held_out // 2, len(cameras), settings.held_out))
    fitted = [view for view in range(len(cameras)) if view not in held_out]
    fit = _Fit(images[fitted], cameras[fitted], settings, seed)
    start = fit.resume(checkpoint.load()) if checkpoint else 0
    for iteration in range(start, settings.iterations):
        loss = fit.step(iteration)
        if not math.isfinite(loss):
            problem = f"the loss is {loss} in iteration {iteration}. Lower radiance.rate_density"
            raise NonFiniteError("radiance field", problem)
        if progress is not None:
            progress(iteration, loss)
        if checkpoint and (iteration + 1) % settings.checkpoint_every == 0:
            checkpoint.save(fit.state(iteration + 1))
    field = fit.field.requires_grad_(False)
    particles = field.particles(settings.spacing, settings.min_opacity)
    scores = [evaluate(field, images, cameras, held_out, part) for part in (particles, None)]
    report = RadianceReport(
        fit.losses, field.lattice.voxel, field.lattice.nodes, len(particles.x), held_out,
        *(value for pair in scores for value in pair),
    )  # fmt: skip
    return field, report


def evaluate(
    field: RadianceField,
    images: Tensor,
    cameras: Cameras,
    views: list[int],
    particles: FieldParticles | None = None,
) -> tuple[float, float]:
    """Mean PSNR [dB] over views with respect to RGBA images over white: full frame, and where alpha > 1/2."""
    errors = (
        (field.draw(cameras, view, particles).clamp(0, 1) - over_white(images[view])) ** 2 for view in views
    )
    return mean_psnr(zip(errors, images[views, ..., 3], strict=True))


class _Fit:
    """The field, its optimiser, and the random state."""

    def __init__(self, images: Tensor, cameras: Cameras, settings: RadianceConfig, seed: int):
        self.settings, self.generator = settings, torch.Generator().manual_seed(seed)
        self.targets = over_white(images).flatten(1, 2)
        self.rays = [camera_rays(cameras, view) for view in range(len(cameras))]
        self.halvings = [round(part * settings.iterations) for part in settings.halvings]
        self.order: list[int] = []
        self.losses: list[float] = []
        lattice = _around(visual_hull(images[..., 3], cameras, settings.hull_resolution), settings)
        with torch.random.fork_rng(devices=[]):  # for the initial network
            torch.manual_seed(seed)
            field = RadianceField(lattice, Opacity(settings.initial_opacity, lattice.voxel))
        self._begin(field.to(images))

    def _begin(self, field: RadianceField) -> None:
        """Continue with a field, a new optimiser, and the rays that intersect its lattice."""
        self.field, settings = field, self.settings
        self.optimizer = torch.optim.Adam(
            [
                {"params": list(parameters), "first_lr": rate}
                for parameters, rate in (
                    ([field.density], settings.rate_density * field.opacity.base_voxel / field.lattice.voxel),
                    ([field.features], settings.rate_features),
                    (field.network.parameters(), settings.rate_network),
                )
            ]
        )
        self.meeting = [field.lattice.intersected(*rays).nonzero()[:, 0] for rays in self.rays]

    def step(self, iteration: int) -> float:
        """One Adam step."""
        settings = self.settings
        if iteration in self.halvings:
            self._begin(self.field.halved())
        if not self.order:
            self.order = torch.randperm(len(self.rays), generator=self.generator).tolist()
        view = self.order.pop()
        drawn = torch.randint(len(self.meeting[view]), (settings.rays,), generator=self.generator)
        chosen = self.meeting[view][drawn.to(self.targets.device)]
        particles = self.field.particles(settings.spacing, settings.min_opacity, self.generator)
        rays = (part[chosen] for part in self.rays[view])
        colours, passed = self.field.render(*particles.seen(), *rays)
        loss = ((colours - self.targets[view, chosen]) ** 2).mean()
        doublings = math.floor(iteration / settings.iterations * settings.entropy_doublings)
        weight = min(settings.entropy_weight * 2**doublings, settings.max_entropy_weight)
        passed = passed.clamp(CERTAIN, 1 - CERTAIN)
        entropy = -(passed * passed.log() + (1 - passed) * (1 - passed).log()).mean()
        fuzzy = particles.opacities.clamp(*VOLUME_RANGE).sum() * particles.volume / particles.voxel
        loss = loss + weight * entropy + settings.volume_weight * fuzzy
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for group in self.optimizer.param_groups:
            group["lr"] = group["first_lr"] * settings.rate_decay ** self._done(iteration)
        self.optimizer.step()
        self.losses.append(float(loss.detach()))
        return self.losses[-1]

    def _done(self, iteration: int) -> float:
        """Progress since the last halving, from 0 to 1."""
        first = self.halvings[-1] if self.halvings else 0
        return max(0.0, (iteration - first) / (self.settings.iterations - first))

    def state(self, iteration: int) -> dict:
        """State for a checkpoint."""
        lattice = self.field.lattice
        return {
            "iteration": iteration,
            "lattice": [list(lattice.origin), lattice.voxel, list(lattice.nodes)],
            "field": self.field.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "order": self.order,
            "losses": self.losses,
        }

    def resume(self, state: dict | None) -> int:
        """Restore a state, if any, and return the next iteration."""
        if state is None:
            return 0
        origin, voxel, nodes = state["lattice"]
        lattice, like = Lattice(tuple(origin), voxel, tuple(nodes)), self.field
        field = RadianceField.of_state(lattice, like.opacity, state["field"], like.network)
        self._begin(field.to(like.density))
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        self.order, self.losses = list(state["order"]), list(state["losses"])
        return state["iteration"]


def _around(hull: Hull, settings: RadianceConfig) -> Lattice:
    """The coarsest lattice, centred on the bounding box of a visual hull."""
    volume = float(hull.occupied.sum()) * hull.voxel**3
    last = (volume / settings.particles) ** (1 / 3) / settings.spacing
    voxel = settings.voxel or 2 ** len(settings.halvings) * last
    occupied = hull.occupied.nonzero()
    low, high = (hull.origin + hull.voxel * corner for corner in (occupied.amin(0), occupied.amax(0) + 1))
    cells = ((high - low) / voxel).ceil().clamp(min=1)
    origin = (low + high - voxel * cells) / 2
    return Lattice(tuple(origin.tolist()), voxel, tuple(int(n) + 1 for n in cells.tolist()))


def _check(images: Tensor, cameras: Cameras, held_out: int) -> None:
    expected = (len(cameras), cameras.height, cameras.width, 4)
    if tuple(images.shape) != expected:
        raise InputError("images", f"shape {tuple(images.shape)} must be {expected}, as for the cameras")
    if len(cameras) <= max(1, held_out // 2):
        problem = f"{held_out} leaves no held-out view of {len(cameras)}"
        raise InputError("radiance.held_out", problem, "Lower it")
    check_masks(images[..., 3])
