"""Static fit of Gaussians: visual hull, loss, quality on a held-out view, determinism, bad input."""

import dataclasses

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from neuma_lib.config.gaussians import DensificationConfig, GaussiansConfig
from neuma_lib.errors import InputError
from neuma_lib.fitting.gaussians import fit_gaussians
from neuma_lib.fitting.image_quality import ssim_map
from neuma_lib.geometry.visual_hull import visual_hull
from neuma_lib.splatting.spherical_harmonics import coefficient_count
from tests.support import raycast
from tests.support.errors import refused

pytestmark = pytest.mark.core

SIZE = 64
SMALL = GaussiansConfig(
    iterations=400,
    initial_count=500,
    hull_resolution=40,
    held_out=8,
    densification=DensificationConfig(every=40, max_count=700),
)


@pytest.fixture(scope="module")
def duck():
    cameras = raycast.sphere_cameras(24, SIZE)
    return raycast.render(cameras, samples=2), cameras


@pytest.fixture(scope="module")
def fit(duck):
    return fit_gaussians(*duck, SMALL, seed=3)


def test_held_out_views_are_reproduced(fit):
    _, report = fit
    assert report.held_out == [4, 12, 20]
    assert report.psnr > 30 and report.psnr_object > 24
    assert np.mean(report.losses[-30:]) < 0.3 * np.mean(report.losses[:30])


def test_gaussians_are_usable_for_binding(fit):
    """Inside or on the body, not needles, not transparent, as many as allowed."""
    gaussians, report = fit
    assert report.count == len(gaussians) <= 700
    assert (gaussians.opacities > SMALL.cull_opacity).all()
    ratio = gaussians.scales.amax(1) / gaussians.scales.amin(1)
    assert ratio.median() < 1.3 * SMALL.max_anisotropy
    assert (raycast.distance(gaussians.means) < 0.02).float().mean() > 0.97
    assert gaussians.shN.shape[1] == coefficient_count(SMALL.sh_degree) - 1
    assert torch.allclose(gaussians.quats.norm(dim=1), torch.ones(len(gaussians)))


def test_some_gaussians_fill_the_inside(fit):
    assert (raycast.distance(fit[0].means) < -0.03).sum() >= 20


def test_visual_hull_holds_the_body(duck):
    images, cameras = duck
    hull = visual_hull(images[..., 3], cameras, 48)
    index = torch.stack(
        torch.meshgrid(*(torch.arange(n) for n in hull.occupied.shape), indexing="ij"), dim=-1
    )
    truth = raycast.distance(hull.origin + (index + 0.5) * hull.voxel) < 0
    assert hull.occupied[truth].float().mean() > 0.99
    # the hull of a nearly convex body is a voxel's width larger
    assert truth.sum() > 0.7 * hull.occupied.sum()


def test_same_seed_same_bytes(duck):
    short = SMALL.model_copy(
        update=dict(iterations=60, densification=DensificationConfig(every=10, max_count=600))
    )
    a, b = (fit_gaussians(*duck, short, seed=5)[0] for _ in range(2))
    for field in dataclasses.fields(a):
        assert getattr(a, field.name).numpy().tobytes() == getattr(b, field.name).numpy().tobytes()


def test_background_and_transparent_colours_do_not_matter(duck):
    """Colours under alpha = 0 are never read."""
    images, cameras = duck
    painted = images.clone()
    painted[..., :3][images[..., 3] == 0] = 0.77
    short = SMALL.model_copy(update=dict(iterations=5))
    a, b = (fit_gaussians(pictures, cameras, short, seed=5)[1] for pictures in (images, painted))
    assert a.losses == b.losses and a.psnr == b.psnr


def test_progress_and_degree(duck):
    seen = []
    settings = SMALL.model_copy(update=dict(iterations=4, sh_degree=0))
    gaussians, _ = fit_gaussians(
        *duck, settings, progress=lambda iteration, loss: seen.append((iteration, loss))
    )
    assert [iteration for iteration, _ in seen] == [0, 1, 2, 3] and gaussians.shN.shape[1] == 0


def test_rates_decay_geometrically(duck, monkeypatch):
    """To a hundredth for the means and a tenth for all others at the end of the fit."""
    rates, step = [], torch.optim.Adam.step

    def recorded(self, *given):
        rates.append({group["name"]: group["lr"] for group in self.param_groups})
        return step(self, *given)

    monkeypatch.setattr(torch.optim.Adam, "step", recorded)
    fit_gaussians(*duck, SMALL.model_copy(update=dict(iterations=4)))
    assert len(rates) == 4 and len(rates[0]) == 6
    for name, first in rates[0].items():
        end = 0.01 if name == "means" else 0.1
        assert [each[name] for each in rates] == pytest.approx([first * end ** (k / 4) for k in range(4)])


def test_ssim_equals_skimage_and_gradients_are_finite_differences():
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(1, 40, 33, 3, generator=generator, dtype=torch.float64)
    b = (a + 0.2 * torch.rand(1, 40, 33, 3, generator=generator, dtype=torch.float64)).clamp(0, 1)
    _, expected = structural_similarity(
        a[0].numpy(), b[0].numpy(), gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=-1, full=True,
    )  # fmt: skip
    inner = (slice(5, -5), slice(5, -5))  # where no window leaves the image
    actual = ssim_map(a, b)[0].movedim(0, -1).numpy()
    assert np.abs(actual[inner] - expected[inner]).max() < 1e-9
    small = [image[:, :7, :6].clone().requires_grad_() for image in (a, b)]
    assert torch.autograd.gradcheck(ssim_map, small)


def test_empty_mask_is_named(duck):
    images, cameras = duck
    images = images.clone()
    images[7, ..., 3] = 0
    with pytest.raises(InputError, match="view 7"):
        fit_gaussians(images, cameras, SMALL)


def test_masks_of_other_poses_are_refused(duck):
    images, cameras = duck
    moved = dataclasses.replace(cameras, viewmats=cameras.viewmats.clone())
    moved.viewmats[:, 0, 3] += torch.linspace(-0.5, 0.5, len(cameras))
    with pytest.raises(InputError, match="poses"):
        fit_gaussians(images, moved, SMALL)


def test_wrong_image_size_is_refused(duck):
    images, cameras = duck
    with refused("images"):
        fit_gaussians(images[:, :32], cameras, SMALL)
