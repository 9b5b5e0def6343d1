"""Gaussians, their harmonics, and their deformation by particles."""

import pytest
import torch

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.deformation import arms_at_rest, deform
from neuma_lib.splatting import spherical_harmonics as harmonics
from neuma_lib.splatting.gaussians import Gaussians, rotations
from tests.support.errors import refused
from tests.support.render_scenes import dense

pytestmark = pytest.mark.core


def some_gaussians(count=7, coefficients=4, seed=0):
    generator = torch.Generator().manual_seed(seed)
    uniform = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    return Gaussians(
        means=uniform(count, 3),
        quats=uniform(count, 4) - 0.5,
        scales=0.1 + uniform(count, 3),
        opacities=uniform(count),
        sh0=uniform(count, 1, 3),
        shN=uniform(count, coefficients - 1, 3),
    )


def test_covariances_have_the_scales_as_axes():
    gaussians = some_gaussians()
    eigenvalues = torch.linalg.eigvalsh(gaussians.covars())
    assert torch.allclose(eigenvalues, torch.sort(gaussians.scales**2, dim=-1).values)
    R = rotations(gaussians.quats)
    assert torch.allclose(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(7, 3, 3))
    assert torch.allclose(torch.linalg.det(R), torch.ones(7, dtype=torch.float64))


def test_quaternion_is_scalar_first():
    quarter_turn_about_z = torch.tensor([[0.5**0.5, 0, 0, 0.5**0.5]], dtype=torch.float64)
    x, y = torch.eye(3, dtype=torch.float64)[:2]
    assert torch.allclose(rotations(quarter_turn_about_z)[0] @ x, y)


def test_cull_and_index_keep_everything_together():
    gaussians = some_gaussians()
    kept = gaussians.cull(0.5)
    assert len(kept) == int((gaussians.opacities > 0.5).sum()) and kept.shN.shape[1] == 3
    assert torch.equal(kept.sh(), gaussians.sh()[gaussians.opacities > 0.5])


def test_wrong_shape_is_named():
    gaussians = some_gaussians()
    with refused("gaussians: quats"):
        Gaussians(
            gaussians.means,
            gaussians.scales,
            gaussians.scales,
            gaussians.opacities,
            gaussians.sh0,
            gaussians.shN,
        )


def test_harmonics_are_orthonormal():
    # product rule on the sphere that is exact for polynomials of degree 6
    k = torch.arange(1, 8, dtype=torch.float64)
    off_diagonal = k / (4 * k * k - 1) ** 0.5
    nodes, weights = torch.linalg.eigh(torch.diag(off_diagonal, 1) + torch.diag(off_diagonal, -1))
    weights = 2 * weights[0] ** 2
    phi = torch.arange(16, dtype=torch.float64) * (2 * torch.pi / 16)
    s = (1 - nodes**2).sqrt()
    directions = torch.stack(
        [s[:, None] * torch.cos(phi), s[:, None] * torch.sin(phi), nodes[:, None].expand(-1, 16)], dim=-1
    )
    values = harmonics.basis(directions, 16)
    gram = torch.einsum("i,ipk,ipl->kl", weights * 2 * torch.pi / 16, values, values)
    assert (gram - torch.eye(16)).abs().max() < 1e-12


def test_colour_round_trip():
    rgb = torch.tensor([[0.1, 0.5, 0.9]])
    sh0 = harmonics.rgb_to_sh0(rgb)
    assert torch.allclose(harmonics.sh0_to_rgb(sh0), rgb)
    assert torch.allclose(harmonics.colours(sh0[:, None], torch.tensor([[0.0, 0.6, 0.8]])), rgb)


def deformation_case(seed=0, frames=3, particles=11):
    generator = torch.Generator().manual_seed(seed)
    gaussians = some_gaussians(seed=seed)
    matrix = torch.rand(len(gaussians), particles, generator=generator, dtype=torch.float64)
    every = torch.arange(matrix.numel() + 1)
    binding = Binding(
        every[::particles], every[:-1] % particles, (matrix / matrix.sum(dim=1, keepdim=True)).flatten(), matrix.shape
    )  # fmt: skip
    x0 = torch.rand(particles, 3, generator=generator, dtype=torch.float64)
    x = x0 + 0.1 * torch.randn(frames, particles, 3, generator=generator, dtype=torch.float64)
    F = torch.eye(3) + 0.2 * torch.randn(frames, particles, 3, 3, generator=generator, dtype=torch.float64)
    return gaussians, binding, x0, x, F, generator


def test_affine_motion_carries_gaussians_exactly():
    """x -> A x + b on every particle takes covariances to A A_0 A^T and means along with their particles."""
    gaussians, binding, x0, _, _, generator = deformation_case()
    A = torch.eye(3) + 0.3 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    b = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    covars0 = gaussians.covars()
    F = A.expand(1, len(x0), 3, 3)
    means, covars = deform(gaussians.means, covars0, binding, x0, (x0 @ A.T + b)[None], F)
    anchors = dense(binding) @ x0
    assert torch.allclose(means[0] - gaussians.means, anchors @ A.T + b - anchors)
    assert torch.allclose(covars[0], A @ covars0 @ A.T)


def test_affine_motion_carries_offset_gaussians_exactly():
    """With arms, x -> A x + b on every particle takes the centres to A x + b too, wherever they lie."""
    gaussians, binding, x0, _, _, generator = deformation_case()
    A = torch.eye(3) + 0.3 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    b = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    arms = arms_at_rest(gaussians.means, binding, x0)
    assert torch.allclose(arms, gaussians.means - dense(binding) @ x0)
    F = A.expand(1, len(x0), 3, 3)
    means, _ = deform(gaussians.means, gaussians.covars(), binding, x0, (x0 @ A.T + b)[None], F, arms=arms)
    assert torch.allclose(means[0], gaussians.means @ A.T + b)


@pytest.mark.parametrize("affine", [False, True])
def test_rest_state_is_unchanged(affine):
    gaussians, binding, x0, _, _, _ = deformation_case()
    arms = arms_at_rest(gaussians.means, binding, x0) if affine else None
    identity = torch.eye(3, dtype=torch.float64).expand(2, len(x0), 3, 3)
    means, covars = deform(
        gaussians.means, gaussians.covars(), binding, x0, x0.expand(2, -1, 3), identity, arms=arms
    )
    assert (means - gaussians.means).abs().max() < 1e-15
    assert (covars - gaussians.covars()).abs().max() < 1e-14


@pytest.mark.parametrize("affine", [False, True])
@pytest.mark.parametrize("covariance_gradient", [True, False])
def test_deformation_gradient(covariance_gradient, affine):
    gaussians, binding, x0, x, F, generator = deformation_case()
    arms = arms_at_rest(gaussians.means, binding, x0) if affine else None
    covars0 = gaussians.covars()
    weight_m = torch.randn(3, 7, 3, generator=generator, dtype=torch.float64)
    weight_c = torch.randn(3, 7, 3, 3, generator=generator, dtype=torch.float64)
    dx = torch.randn(x.shape, generator=generator, dtype=torch.float64)
    dF = torch.randn(F.shape, generator=generator, dtype=torch.float64)

    def loss(x, F):
        means, covars = deform(
            gaussians.means, covars0, binding, x0, x, F, arms=arms, covariance_gradient=covariance_gradient
        )
        return (weight_m * means).sum() + (weight_c * covars).sum()

    x, F = x.requires_grad_(), F.requires_grad_()
    grad_x, grad_F = torch.autograd.grad(loss(x, F), (x, F), allow_unused=True)
    h = 1e-6
    with torch.no_grad():
        along_x = (loss(x + h * dx, F) - loss(x - h * dx, F)) / (2 * h)
        along_F = (loss(x, F + h * dF) - loss(x, F - h * dF)) / (2 * h)
    assert abs((grad_x * dx).sum() - along_x) < 1e-7 * abs(along_x)
    if covariance_gradient:
        assert abs((grad_F * dF).sum() - along_F) < 1e-7 * abs(along_F)
    else:
        assert grad_F is None
