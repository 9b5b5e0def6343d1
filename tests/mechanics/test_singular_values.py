"""Singular values and rotations of 3x3 matrices: to round-off forward, safe at repeated values backward."""

import pytest
import torch

from neuma_lib.mechanics.singular_values import rotation_and_singular_values, svd3
from tests.support.deformations import rotations

pytestmark = pytest.mark.core

ROUNDINGS = 32  # units of eps: some 15 rotations of three-vectors, each rounding a few times


def stretched(sigma: list[float], count: int = 500) -> torch.Tensor:
    return rotations(count, 1) @ torch.diag(torch.tensor(sigma, dtype=torch.float64)) @ rotations(count, 2)


def families() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(2000, 3, 3, generator=generator, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    return {
        "random": noise,
        "near the identity": eye + 1e-5 * noise,
        "identity": eye.repeat(11, 1, 1),
        "rotations": rotations(500),
        "two equal": stretched([2.0, 1.0, 1.0]),
        "inverted": stretched([1.5, 1.0, -0.5]),
        "inverted, equal": stretched([1.0, 0.7, -0.7]),
        "ill-conditioned": stretched([1.0, 1e-2, 1e-5]),
        "rank two": stretched([1.0, 0.5, 0.0]),
        "rank one": stretched([1.0, 0.0, 0.0]),
        "zero": torch.zeros(5, 3, 3, dtype=torch.float64),
        "tiny": 1e-12 * noise,
        "huge": 1e12 * noise,
    }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("family", families())
def test_svd_reconstructs_to_round_off(family, dtype):
    F = families()[family].to(dtype)
    U, sigma, Vh = (x.double() for x in svd3(F))
    F, eps, eye = F.double(), torch.finfo(dtype).eps, torch.eye(3, dtype=torch.float64)
    size = F.norm(dim=(1, 2)).clamp(min=1e-300)
    assert float((((U * sigma[:, None]) @ Vh - F).norm(dim=(1, 2)) / size).max()) < ROUNDINGS * eps
    assert float((U @ U.mT - eye).abs().max()) < ROUNDINGS * eps
    assert float((Vh @ Vh.mT - eye).abs().max()) < ROUNDINGS * eps
    error = (sigma.abs() - torch.linalg.svdvals(F)).abs().amax(1) / size
    assert float(error.max()) < ROUNDINGS * eps


@pytest.mark.parametrize("family", families())
def test_svd_convention(family):
    F = families()[family]
    U, sigma, Vh = svd3(F)
    torch.testing.assert_close(torch.linalg.det(U), torch.ones(len(F), dtype=F.dtype))
    torch.testing.assert_close(torch.linalg.det(Vh), torch.ones(len(F), dtype=F.dtype))
    slack = ROUNDINGS * torch.finfo(F.dtype).eps * sigma[:, 0]
    assert bool((sigma[:, 0] >= sigma[:, 1] - slack).all())
    assert bool((sigma[:, 1] >= sigma[:, 2].abs() - slack).all())
    det = torch.linalg.det(F)
    clear = det.abs() > 1e-9 * sigma[:, 0] ** 3
    assert bool((det.sign() == sigma[:, 2].sign())[clear].all())


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9])
def test_svd_of_any_count(count):
    F = families()["random"][:count]
    U, sigma, Vh = svd3(F)
    assert U.shape == F.shape and sigma.shape == (count, 3)
    torch.testing.assert_close((U * sigma[:, None]) @ Vh, F)


def test_svd_accepts_strided_input():
    F = families()["random"]
    torch.testing.assert_close(svd3(F.mT)[1], svd3(F.mT.contiguous())[1], rtol=0, atol=0)


def directional_error(function, F: torch.Tensor) -> float:
    """Largest relative difference of the gradient and a central difference along random directions."""
    generator = torch.Generator().manual_seed(5)
    direction = torch.randn(F.shape, generator=generator, dtype=F.dtype)
    leaf = F.clone().requires_grad_()
    value = function(leaf)
    (grad,) = torch.autograd.grad(value.sum(), leaf)
    step = 1e-6
    difference = (function(F + step * direction) - function(F - step * direction)) / (2 * step)
    exact = (grad * direction).sum((1, 2))
    return float(((difference - exact).abs() / (exact.abs() + exact.abs().mean())).max())


def rotation_probe(F):
    generator = torch.Generator().manual_seed(6)
    weights = torch.randn(F.shape, generator=generator, dtype=F.dtype)
    return (rotation_and_singular_values(F)[0] * weights).sum((1, 2))


def symmetric_probe(F):
    sigma = rotation_and_singular_values(F)[1]
    return sigma.sum(1) + 0.3 * (sigma**2).sum(1) + sigma.prod(1) + sigma.sin().sum(1)


@pytest.mark.parametrize(
    "family", ["random", "near the identity", "identity", "rotations", "two equal", "inverted"]
)
@pytest.mark.parametrize("probe", [rotation_probe, symmetric_probe])
def test_adjoint_against_differences(family, probe):
    F = families()[family][:500]
    if family == "random":  # away from det F = 0 with two equal singular values, where R jumps
        sigma = svd3(F)[1]
        F = F[(sigma[:, 1] + sigma[:, 2]) > 0.2]
    # central differences: eps / step of rounding plus step^2 of truncation, amplified by the curvature of R
    assert directional_error(probe, F) < 1e-7


def test_single_singular_values_where_they_are_apart():
    F = families()["random"]
    sigma = svd3(F)[1]
    F = F[((sigma[:, :2] - sigma[:, 1:].abs()) > 0.1).all(1)]
    assert len(F) > 100
    for i in range(3):
        assert directional_error(lambda F, i=i: rotation_and_singular_values(F)[1][:, i], F) < 1e-7


def test_gradient_in_single_precision_at_the_identity():
    F = torch.eye(3).repeat(50, 1, 1)
    grads = []
    for dtype in (torch.float32, torch.float64):
        leaf = F.to(dtype, copy=True).requires_grad_()
        weights = torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(0)).to(dtype)
        ((rotation_and_singular_values(leaf)[0] * weights).sum() + symmetric_probe(leaf).sum()).backward()
        grads.append(leaf.grad.double())
    error = (grads[0] - grads[1]).abs().max() / grads[1].abs().max()
    assert float(error) < ROUNDINGS * torch.finfo(torch.float32).eps


def test_gradient_stays_finite_where_the_rotation_is_singular():
    F = torch.cat(
        [families()["inverted, equal"], families()["rank one"], families()["zero"]]
    ).requires_grad_()
    (rotation_probe(F).sum() + symmetric_probe(F).sum()).backward()
    assert bool(torch.isfinite(F.grad).all())


def test_rotation_follows_a_turned_body():
    Q, F = rotations(200, 7), families()["random"][:200]
    R, sigma = rotation_and_singular_values(F)
    R_turned, sigma_turned = rotation_and_singular_values(Q @ F)
    gap = 0.05  # between the two smallest singular values, with sign: rounding turns R by eps |F| over it
    clear = (sigma[:, 1] + sigma[:, 2]) > gap
    assert int(clear.sum()) > 160
    rounding = 2 * ROUNDINGS * torch.finfo(F.dtype).eps * float(sigma.max())
    assert float((R_turned - Q @ R)[clear].abs().max()) < rounding / gap
    assert float((sigma_turned - sigma).abs().max()) < rounding
