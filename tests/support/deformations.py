"""Deformations and checks that the tests of materials share."""

import torch

from neuma_lib.mechanics.adaptor import AdaptableLaw
from neuma_lib.mechanics.law import Constitutive

E, NU = 1e5, 0.3
EYE = torch.eye(3, dtype=torch.float64)


def rotations(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    Q, R = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    Q = Q * R.diagonal(dim1=1, dim2=2).sign()[:, None]
    return Q * torch.linalg.det(Q)[:, None, None]


def deformations(count: int = 400, size: float = 0.15, seed: int = 1) -> torch.Tensor:
    """Random rotations times stretches with random log strains of the given size."""
    generator = torch.Generator().manual_seed(seed)
    strain = size * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return (rotations(count, seed + 1) * strain.exp()[:, None]) @ rotations(count, seed + 2)


def weights_of(part: Constitutive, dtype=torch.float64) -> tuple[torch.Tensor, ...]:
    return tuple(w.detach().to(dtype) for w in part.weights())


def hencky_deviator(F: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Trace and deviator (N, 3) of the log strain, through an eigenvalue solver."""
    strain = 0.5 * torch.linalg.eigvalsh(F.mT @ F).log()
    trace = strain.sum(1, keepdim=True)
    return trace, strain - trace / 3


def stiffness(part: Constitutive) -> float:
    """Largest change of a law's value per change of F, for the deformations used here."""
    F = deformations(50)
    probe = torch.randn(F.shape, generator=torch.Generator().manual_seed(8), dtype=F.dtype)
    return float(part.vjp(F, weights_of(part), probe)[0].norm(dim=(1, 2)).max())


def steady_shear(part: Constitutive, rate: float, dt: float, steps: int = 400) -> torch.Tensor:
    """Elastic deformation gradient (1, 3, 3) after steps of a simple shear at a rate [1/s]."""
    gradient = torch.zeros(3, 3, dtype=torch.float64)
    gradient[0, 1] = rate
    F = EYE[None].clone()
    for _ in range(steps):
        F = part.evaluate((EYE + dt * gradient) @ F, ())
    return F


def assert_adjoint(part: Constitutive, F: torch.Tensor) -> None:
    """`vjp` against central differences in float64: of each row of F, and of all weights together."""
    weights = weights_of(part)
    generator = torch.Generator().manual_seed(30)
    direction, probe = torch.randn(2, *F.shape, generator=generator, dtype=F.dtype)
    turns = tuple(w.abs().max() * torch.randn(w.shape, generator=generator, dtype=F.dtype) for w in weights)
    grad_F, grads = part.vjp(F, weights, probe)
    step = 1e-6

    def along(sign, moves_F, moves_weights):
        moved = tuple(w + sign * step * moves_weights * t for w, t in zip(weights, turns, strict=True))
        return (part.evaluate(F + sign * step * moves_F * direction, moved) * probe).sum((1, 2))

    difference = (along(1, 1, 0) - along(-1, 1, 0)) / (2 * step)
    exact = (grad_F * direction).sum((1, 2))
    # rounding eps / step, and the third derivatives of a network whose input is a strain in a small unit
    assert float((difference - exact).abs().max()) < 1e-7 * float(grad_F.norm(dim=(1, 2)).max())
    difference = float((along(1, 0, 1) - along(-1, 0, 1)).sum() / (2 * step))
    exact = float(sum((g * t).sum() for g, t in zip(grads, turns, strict=True)))
    size = float(sum(g.norm() * t.norm() for g, t in zip(grads, turns, strict=True)))
    assert abs(difference - exact) <= 1e-7 * size


def randomise_adaptor(law: AdaptableLaw, size: float = 0.3, seed: int = 0) -> None:
    """Set the trainable parameters of a law to random numbers of a size."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in (p for p in law.parameters() if p.requires_grad):
            p.copy_(size * torch.randn(p.shape, generator=generator))
