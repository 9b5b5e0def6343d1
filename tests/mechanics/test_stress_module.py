"""Laws as modules of other solvers: stresses and consistent tangents without a simulator."""

import pytest
import torch

import neuma_lib as nm
from neuma_lib.io.exported import about_law
from neuma_lib.io.laws import save_law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import structured_law

pytestmark = pytest.mark.core

HENCKY = {"name": "hencky", "E": 2e4, "nu": 0.3}
SPECS = {
    **{
        name: {"elasticity": {**HENCKY, "name": name}}
        for name in ("hencky", "neo_hookean", "fixed_corotated", "stvk")
    },
    "von_mises": {"elasticity": HENCKY, "plasticity": {"name": "von_mises", "yield_stress": 500.0}},
    "drucker_prager": {
        "elasticity": HENCKY,
        "plasticity": {"name": "drucker_prager", "friction_angle": 30.0},
    },
    "viscous": {"elasticity": HENCKY, "plasticity": {"name": "viscous_flow", "viscosity": 5.0}},
}
LAWS = {
    **{name: lambda spec=spec: nm.Law.from_spec(spec, dt=1e-3) for name, spec in SPECS.items()},
    "networks": lambda: neural_law(seed=1),
    "structured": lambda: structured_law({**SPECS["von_mises"], "form": "stretch"}, 1e-3),
}


def trials(count=6, size=0.1):
    generator = torch.Generator().manual_seed(4)
    F = torch.eye(3, dtype=torch.float64) + size * torch.randn(
        count, 3, 3, generator=generator, dtype=torch.float64
    )
    return 0.97 * F


@pytest.mark.parametrize("make", LAWS.values(), ids=LAWS)
def test_the_tangent_is_the_derivative_of_the_stress(make, tmp_path):
    law = make()
    save_law(tmp_path / "law.safetensors", law, about_law(law, 1e-3))
    law = nm.Law.load(tmp_path / "law.safetensors")
    F, step = trials(), 1e-6
    expected = torch.empty(len(F), 3, 3, 3, 3, dtype=F.dtype)
    for k in range(3):
        for n in range(3):
            change = torch.zeros(3, 3, dtype=F.dtype)
            change[k, n] = step
            with torch.no_grad():
                expected[..., k, n] = (law.first_piola(F + change) - law.first_piola(F - change)) / (2 * step)
    tangent = law.tangent(F)
    assert tangent.dtype == torch.float64 and not tangent.requires_grad
    assert (tangent - expected).abs().max() < 1e-5 * expected.abs().max()


@pytest.mark.parametrize("make", LAWS.values(), ids=LAWS)
def test_stresses_agree_with_each_other_and_in_single_precision(make):
    law, F = make(), trials()
    with torch.no_grad():
        tau, P = law.kirchhoff(F), law.first_piola(F)
        single = law.first_piola(F.float())
        simulated = law.elasticity.evaluate(
            law.plasticity.evaluate(F.float(), law.plasticity.weights()), law.elasticity.weights()
        )
    torch.testing.assert_close(P @ F.mT, tau, rtol=1e-12, atol=1e-12 * float(tau.abs().max()))
    assert single.dtype == torch.float32
    for value, true in ((single, P), (simulated, tau)):
        assert (value - true).abs().max() < 2e-5 * true.abs().max()


@pytest.mark.parametrize("name", ["hencky", "neo_hookean", "fixed_corotated", "stvk"])
def test_a_hyperelastic_tangent_is_symmetric_and_hooke_at_rest(name):
    law = nm.Law.from_spec(SPECS[name])
    A = law.tangent(trials()).reshape(-1, 9, 9)
    assert (A - A.mT).abs().max() < 1e-9 * A.abs().max()
    mu, lam = 2e4 / 2.6, 2e4 * 0.3 / (1.3 * 0.4)
    eye = torch.eye(3, dtype=torch.float64)
    hooke = lam * torch.einsum("ij,kl->ijkl", eye, eye)
    hooke += mu * (torch.einsum("ik,jl->ijkl", eye, eye) + torch.einsum("il,jk->ijkl", eye, eye))
    torch.testing.assert_close(law.tangent(eye[None])[0], hooke, rtol=1e-4, atol=1e-4 * mu)


def test_forces_of_a_patch_of_elements_balance():
    """Linear displacements of an irregular patch give no force at its inner node, for any law of no flow."""
    corners = torch.tensor(
        [[i, j, k] for i in (0.0, 1) for j in (0.0, 1) for k in (0.0, 1)], dtype=torch.float64
    )
    x = torch.cat([corners, torch.tensor([[0.4, 0.55, 0.6]], dtype=torch.float64)])
    faces = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6), (0, 2, 6),
             (0, 6, 4), (1, 7, 3), (1, 5, 7)]  # fmt: skip
    elements = torch.tensor([(*face, 8) for face in faces])
    H = torch.tensor([[0.05, 0.1, 0.0], [0.0, -0.08, 0.04], [0.03, 0.0, 0.02]], dtype=torch.float64)
    D = (x[elements[:, 1:]] - x[elements[:, :1]]).mT
    d = ((x + x @ H.mT)[elements[:, 1:]] - (x + x @ H.mT)[elements[:, :1]]).mT
    P = nm.Law.from_spec(SPECS["neo_hookean"]).first_piola(d @ torch.linalg.inv(D))
    forces = P @ torch.linalg.inv(D).mT * torch.linalg.det(D).abs()[:, None, None] / 6
    nodal = torch.zeros_like(x)
    for corner in range(3):
        nodal.index_add_(0, elements[:, corner + 1], forces[:, :, corner])
    nodal.index_add_(0, elements[:, 0], -forces.sum(dim=2))
    assert nodal[8].norm() < 1e-10 * nodal.norm()
