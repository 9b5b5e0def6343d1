"""Constitutive laws: closed forms, invariances, yield surfaces, adjoints, files."""

import math

import pytest
import torch
from safetensors.torch import load

from neuma_lib.errors import InputError
from neuma_lib.io.laws import load_prior
from neuma_lib.io.weights import write_weights
from neuma_lib.mechanics.adaptor import Adaptor
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.elasticity import ELASTICITIES, Hencky, Tait
from neuma_lib.mechanics.isotropic import lame
from neuma_lib.mechanics.law import Constitutive, Law
from neuma_lib.mechanics.neural import CPU_ROWS, SHAPES, neural_law
from neuma_lib.mechanics.plasticity import DruckerPrager, FluidProjection, ViscousFlow, VonMises
from tests.support.deformations import EYE, NU, E, deformations, hencky_deviator, rotations, weights_of
from tests.support.errors import refused

pytestmark = pytest.mark.core

MU, LAM = lame(E, NU)
BESIDE_E_AND_NU = {
    "ogden": {"alpha": 6.0},
    "mooney_rivlin": {"q": 0.7},
    "fibre_reinforced": {"fibre_modulus": 2e5, "fibre_exponent": 1.5},
}
PLASTICITIES = {
    "identity": {},
    "von_mises": {"yield_stress": 5e3},
    "drucker_prager": {"friction_angle": 25},
    "fluid_projection": {},
    "viscous_flow": {"viscosity": 10.0, "yield_stress": 1e3},
    "crushable_foam": {"crush": 4e3, "tension": 1e3, "slope": 1.2, "relaxation": 2e-3},
    "herschel_bulkley": {"consistency": 30.0, "exponent": 0.5, "yield_stress": 1e3},
    "cohesive_drucker_prager": {"friction_angle": 35, "cohesion": 2e3, "dilation_angle": 10},
}


def elastic_spec(name: str) -> dict:
    return {"name": name, "E": E, "nu": NU, **BESIDE_E_AND_NU.get(name, {})}


def elasticity(name: str):
    return analytic_law({"elasticity": elastic_spec(name)}).elasticity


def plasticity(name: str):
    spec = {
        "elasticity": {"name": "hencky", "E": E, "nu": NU},
        "plasticity": {"name": name, **PLASTICITIES[name]},
    }
    return analytic_law(spec, dt=1e-3).plasticity


def all_parts() -> dict[str, Constitutive]:
    """Every analytic law and random networks, the elastic one adapted."""
    parts = {name: elasticity(name) for name in ELASTICITIES}
    parts |= {name: plasticity(name) for name in PLASTICITIES}
    law = neural_law(seed=4)
    law.attach_adaptor(rank=4)
    with torch.no_grad():
        for parameter in law.elasticity.adaptor.parameters():
            parameter.add_(0.1)
    return parts | {"neural elasticity": law.elasticity, "neural plasticity": law.plasticity}


PARTS = list(all_parts())
IS_STRESS = [*ELASTICITIES, "neural elasticity"]


def evaluate(part: Constitutive, F: torch.Tensor) -> torch.Tensor:
    return part.evaluate(F, weights_of(part, F.dtype))


def stiffness(part: Constitutive) -> float:
    """Largest change of the law's value per change of F about the deformations used here."""
    F = deformations(50).requires_grad_()
    probe = torch.randn(F.shape, generator=torch.Generator().manual_seed(8), dtype=F.dtype)
    return float(part.vjp(F.detach(), weights_of(part), probe)[0].norm(dim=(1, 2)).max())


# ------------------------------------------------------------------------------------------- closed forms


def uniaxial_stress(name: str, a: float) -> list[float]:
    """Kirchhoff stresses along and across the axis for F = diag(a, 1, 1), from each law's textbook form."""
    if name == "fixed_corotated":  # P = 2 mu (F - R) + lam (J - 1) J F^-T
        volumetric = LAM * (a - 1) * a
        return [2 * MU * (a - 1) * a + volumetric, volumetric]
    if name == "stvk":  # S = 2 mu G + lam tr(G) I, tau = F S F^T
        green = (a * a - 1) / 2
        return [a * a * (2 * MU + LAM) * green, LAM * green]
    if name == "hencky":
        return [(2 * MU + LAM) * math.log(a), LAM * math.log(a)]
    if name == "tait":  # dev eps = (2/3, -1/3, -1/3) log a
        pressure, shear = (LAM + 2 * MU / 3) / 7 * (a - a**-6), 2 * MU * math.log(a) / 3
        return [pressure + 2 * shear, pressure - shear]
    if name == "neo_hookean":  # tau = mu (b - I) + lam log J I
        return [MU * (a * a - 1) + LAM * math.log(a), LAM * math.log(a)]
    if name in ("ogden", "mooney_rivlin"):  # isochoric stretches a^(2/3), a^(-1/3) twice
        s, pressure = (a ** (2 / 3), a ** (-1 / 3)), (LAM + 2 * MU / 3) * math.log(a)
        if name == "ogden":  # alpha = 6
            shear = 2 * MU / 6 * (s[0] ** 6 - s[1] ** 6)
        else:  # q = 0.7
            shear = MU * (0.3 * (s[0] ** 2 - s[1] ** 2) - 0.7 * (s[0] ** -2 - s[1] ** -2))
        return [2 / 3 * shear + pressure, -shear / 3 + pressure]
    if name == "fibre_reinforced":  # Hencky, and the fibres along the axis
        green = a * a - 1
        fibre = 1e5 * green * math.exp(min(1.5 * green**2, 8)) * a * a
        return [(2 * MU + LAM) * math.log(a) + fibre, LAM * math.log(a)]
    return [LAM * a * (a - 1)] * 2


def simple_shear_stress(name: str, k: float) -> torch.Tensor:
    """tau for F = I + k e_x (x) e_y; J = 1. In the plane; the third principal stretch is 1."""
    F = torch.tensor([[1.0, k], [0.0, 1.0]], dtype=torch.float64)
    plane, eye = torch.zeros(2, 2, dtype=torch.float64), torch.eye(2, dtype=torch.float64)
    out_of_plane = 0.0
    if name == "fixed_corotated":  # the rotation of a simple shear turns by -atan(k / 2)
        angle = -math.atan(k / 2)
        R = torch.tensor(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64
        )
        plane = 2 * MU * (F - R) @ F.mT
    elif name == "stvk":
        green = (F.mT @ F - eye) / 2
        plane = F @ (2 * MU * green + LAM * green.trace() * eye) @ F.mT
        out_of_plane = LAM * float(green.trace())
    elif name in ("hencky", "tait", "fibre_reinforced"):  # fibres along e_x are not strained
        # principal log stretches +-asinh(k / 2), the larger one at atan(k/2 + sqrt(1+k^2/4))
        strain = math.asinh(k / 2)
        angle = math.atan2(1.0, math.sqrt(1 + k * k / 4) - k / 2)  # of the axis, from e_y side
        n = torch.tensor([math.sin(angle), math.cos(angle)], dtype=torch.float64)
        plane = 2 * MU * strain * (2 * torch.outer(n, n) - eye)
    elif name == "neo_hookean":
        plane = MU * (F @ F.mT - eye)
    elif name in ("ogden", "mooney_rivlin"):
        b = F @ F.mT
        if name == "ogden":  # (2 mu / 6) dev b^3
            plane, out_of_plane = MU / 3 * b @ b @ b, MU / 3
        else:
            plane, out_of_plane = MU * (0.3 * b - 0.7 * torch.linalg.inv(b)), MU * (0.3 - 0.7)
        mean = (float(plane.trace()) + out_of_plane) / 3
        plane, out_of_plane = plane - mean * eye, out_of_plane - mean
    tau = torch.zeros(3, 3, dtype=torch.float64)
    tau[:2, :2], tau[2, 2] = plane, out_of_plane
    return tau


@pytest.mark.parametrize("name", ELASTICITIES)
@pytest.mark.parametrize("a", [0.6, 0.95, 1.0, 1.05, 1.7])
def test_uniaxial_stress(name, a):
    along, across = uniaxial_stress(name, a)
    tau = elasticity(name).evaluate(torch.diag(torch.tensor([a, 1.0, 1.0], dtype=torch.float64))[None], ())
    expected = torch.diag(torch.tensor([along, across, across], dtype=torch.float64))[None]
    torch.testing.assert_close(tau, expected, rtol=1e-12, atol=1e-12 * E)


@pytest.mark.parametrize("name", ELASTICITIES)
@pytest.mark.parametrize("k", [-0.4, 0.01, 0.3, 1.5])
def test_simple_shear_stress(name, k):
    F = EYE.clone()
    F[0, 1] = k
    tau = elasticity(name).evaluate(F[None], ())[0]
    torch.testing.assert_close(tau, simple_shear_stress(name, k), rtol=1e-12, atol=1e-12 * E)


@pytest.mark.parametrize("name", ELASTICITIES)
def test_wave_speed_is_that_of_linear_elasticity(name):
    law = analytic_law({"elasticity": elastic_spec(name)})
    modulus = LAM if name == "fluid" else LAM + 2 * MU + BESIDE_E_AND_NU.get(name, {}).get("fibre_modulus", 0)
    # one-sided differences of step 1e-5
    assert law.wave_speed(1000.0) == pytest.approx(math.sqrt(modulus / 1000.0), rel=1e-4)


def test_wave_speed_of_a_network_is_its_tangent():
    """The acoustic tensor in closed form: without features every gelu has slope 1/2, so dX = sym(W2 W1 W0 dz) / 4."""
    law = neural_law(seed=1)
    W0, W1, W2 = weights_of(law.elasticity)
    ticks = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    n = torch.cartesian_prod(ticks, ticks, ticks)
    n = torch.nn.functional.normalize(n[n.abs().sum(1) > 0], dim=1)
    H = torch.einsum("ka,dl->dakl", EYE, n)  # displacement gradient e_a (x) n
    strain = (H + H.mT) / 2
    stretch = torch.linalg.eigvalsh(strain).flip(
        -1
    )  # the sorted singular values move by the sorted eigenvalues
    dz = torch.cat(
        [stretch, 2 * strain.flatten(2), strain.diagonal(dim1=2, dim2=3).sum(-1, keepdim=True)], dim=2
    )
    dX = ((dz @ W0.mT @ W1.mT @ W2.mT) / 4).unflatten(2, (3, 3))
    Q = torch.einsum("daij,dj->dia", (dX + dX.mT) / 2, n)
    exact = float(torch.linalg.eigvalsh((Q + Q.mT) / 2).max())
    # one-sided differences of step 1e-5 err by that times the ratio of second to first derivative, of order one
    assert exact > 0 and law.longitudinal_modulus() == pytest.approx(exact, rel=5e-5)


# ------------------------------------------------------------------------------------------- invariances


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", PARTS)
def test_objectivity(name, dtype):
    """tau(QF) = Q tau(F) Q^T and F_new(QF) = Q F_new(F), to the rounding of the inputs."""
    part = all_parts()[name]
    F, Q = deformations().to(dtype), rotations(400, 20).to(dtype)
    turned = evaluate(part, Q @ F)
    expected = Q @ evaluate(part, F) @ (Q.mT if name in IS_STRESS else torch.eye(3, dtype=dtype))
    tolerance = 64 * torch.finfo(dtype).eps * max(stiffness(part), float(expected.abs().max()))
    assert float((turned - expected).abs().max()) < tolerance


@pytest.mark.parametrize("name", [n for n in PARTS if not n.startswith(("neural", "fibre"))])
def test_analytic_laws_are_isotropic(name):
    part = all_parts()[name]
    F, Q = deformations(), rotations(400, 21)
    expected = evaluate(part, F) if name in IS_STRESS else evaluate(part, F) @ Q
    tolerance = 64 * torch.finfo(F.dtype).eps * max(stiffness(part), float(expected.abs().max()))
    assert float((evaluate(part, F @ Q) - expected).abs().max()) < tolerance


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", IS_STRESS)
def test_rotation_is_free_of_stress(name, dtype):
    part = all_parts()[name]
    tau = evaluate(part, rotations(300, 22).to(dtype))
    assert float(tau.abs().max()) < 32 * torch.finfo(dtype).eps * stiffness(part)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", [*PLASTICITIES, "neural plasticity"])
def test_rotation_is_left_alone_by_plasticity(name, dtype):
    part, Q = all_parts()[name], rotations(300, 22).to(dtype)
    assert float((evaluate(part, Q) - Q).abs().max()) < 32 * torch.finfo(dtype).eps


@pytest.mark.parametrize("name", ELASTICITIES)
def test_analytic_stress_is_symmetric(name):
    tau = elasticity(name).evaluate(deformations(), ())
    assert float((tau - tau.mT).abs().max()) < 8 * torch.finfo(tau.dtype).eps * float(tau.abs().max())


@pytest.mark.parametrize("name", PARTS)
def test_finite_for_crushed_and_inverted_elements(name):
    part = all_parts()[name]
    F = torch.stack([EYE.clone() for _ in range(4)])
    F[0, 1, 1], F[1, 2, 2] = 1e-4, -0.3
    F[2] *= 0
    F[3] *= 5
    for dtype in (torch.float32, torch.float64):
        value = evaluate(part, F.to(dtype))
        grad_F, grad_weights = part.vjp(F.to(dtype), weights_of(part, dtype), torch.ones_like(value))
        assert all(bool(torch.isfinite(x).all()) for x in (value, grad_F, *grad_weights))


# ------------------------------------------------------------------------------------------ yield surfaces


def test_von_mises_projects_onto_its_surface():
    part = plasticity("von_mises")
    F = deformations()
    _, deviator = hencky_deviator(F)
    limit = 5e3 / (2 * MU)
    outside = deviator.norm(dim=1) > limit
    assert 50 < int(outside.sum())
    returned = part.evaluate(F, ())
    trace, deviator_returned = hencky_deviator(returned)
    rounding = 64 * torch.finfo(F.dtype).eps
    stress = Hencky(E=E, nu=NU).evaluate(returned, ())
    deviatoric = stress - EYE * stress.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
    on_surface = deviatoric[outside].norm(dim=(1, 2)) / 5e3 - 1
    assert float(on_surface.abs().max()) < rounding / limit
    assert float((trace - hencky_deviator(F)[0]).abs().max()) < rounding  # volume is kept
    radial = deviator[outside] / deviator[outside].norm(dim=1, keepdim=True) * limit
    assert float((deviator_returned[outside] - radial).abs().max()) < rounding
    assert torch.equal(part.evaluate(deformations(size=1e-3), ()), deformations(size=1e-3))
    assert torch.equal(returned[~outside], F[~outside])


def test_drucker_prager_projects_onto_its_cone():
    part = plasticity("drucker_prager")
    F = deformations()
    trace, deviator = hencky_deviator(F)
    sine = math.sin(math.radians(25))
    alpha = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
    slope = (3 * LAM + 2 * MU) / (2 * MU) * alpha
    height = deviator.norm(dim=1) + slope * trace[:, 0]
    pulled, inside = trace[:, 0] > 0, (trace[:, 0] <= 0) & (height <= 0)
    sheared = ~pulled & ~inside
    assert min(int(pulled.sum()), int(inside.sum()), int(sheared.sum())) > 20
    returned = part.evaluate(F, ())
    rounding = 64 * torch.finfo(F.dtype).eps
    trace_new, deviator_new = hencky_deviator(returned)
    on_cone = deviator_new.norm(dim=1) + slope * trace_new[:, 0]
    assert float(on_cone[sheared].abs().max()) < (1 + slope) * rounding
    assert float((trace_new - trace)[sheared].abs().max()) < rounding
    eye = EYE.expand(int(pulled.sum()), 3, 3)
    assert float((returned[pulled].mT @ returned[pulled] - eye).abs().max()) < rounding  # no tension
    assert torch.equal(returned[inside], F[inside])
    # in stress: |dev tau| <= -alpha tr(tau), the friction cone of the Kirchhoff stress
    tau = Hencky(E=E, nu=NU).evaluate(returned[sheared], ())
    pressure = tau.diagonal(dim1=1, dim2=2).sum(1)
    shear = (tau - EYE * pressure[:, None, None] / 3).norm(dim=(1, 2))
    assert float((shear + alpha * pressure).abs().max()) < rounding * E * 10


@pytest.mark.parametrize("name", ["von_mises", "drucker_prager", "fluid_projection"])
def test_a_second_return_changes_nothing(name):
    part = plasticity(name)
    once = part.evaluate(deformations(), ())
    twice = part.evaluate(once, ())
    assert float((twice - once).abs().max()) < 64 * torch.finfo(once.dtype).eps * (1 + LAM / MU)


def test_cohesion_bears_tension_up_to_its_strain():
    part = DruckerPrager(E=E, nu=NU, friction_angle=25.0, cohesion=0.01)
    held = (EYE * math.exp(0.009))[None]
    torn = (EYE * math.exp(0.012))[None]
    assert torch.equal(part.evaluate(held, ()), held)
    torch.testing.assert_close(part.evaluate(torn, ()), (EYE * math.exp(0.01))[None])


def test_fluid_keeps_volume_and_pressure_and_forgets_shear():
    F = deformations()
    returned = FluidProjection().evaluate(F, ())
    J = torch.linalg.det(F)
    torch.testing.assert_close(torch.linalg.det(returned), J)
    gram = returned.mT @ returned
    torch.testing.assert_close(gram, J[:, None, None] ** (2 / 3) * EYE.expand_as(gram))
    fluid = elasticity("fluid")
    torch.testing.assert_close(
        fluid.evaluate(returned, ()), fluid.evaluate(F, ()), rtol=1e-12, atol=1e-12 * E
    )


def test_viscous_flow_is_newtonian_in_steady_shear():
    """tau_xy = viscosity * shear rate, up to the elastic strain (1e-4 here)."""
    viscosity, rate, dt = 10.0, 1.0, 1e-4
    part, law = ViscousFlow(E=E, nu=NU, viscosity=viscosity, dt=dt), Hencky(E=E, nu=NU)
    velocity_gradient = torch.zeros(3, 3, dtype=torch.float64)
    velocity_gradient[0, 1] = rate
    F = EYE[None].clone()
    for _ in range(400):
        F = part.evaluate((EYE + dt * velocity_gradient) @ F, ())
    strain = viscosity * rate / MU
    assert float(law.evaluate(F, ())[0, 0, 1]) == pytest.approx(
        viscosity * rate, rel=4 * (strain + rate * dt)
    )


def test_a_projected_tait_fluid_knows_its_volume_alone():
    """PAC-NeRF's weakly compressible fluid without viscosity: kappa (J - J^-6) I, whatever the deformation."""
    F = deformations(50)
    part, law = FluidProjection(), Tait(E=E, nu=NU)
    J = torch.linalg.det(F)[:, None, None]
    expected = (LAM + 2 * MU / 3) / 7 * (J - J**-6) * EYE
    torch.testing.assert_close(law.evaluate(part.evaluate(F, ()), ()), expected, rtol=1e-10, atol=1e-10 * E)


def test_a_bingham_body_bears_its_yield_stress_and_flows_beyond_it():
    """Steady shear: tau_xy = yield_stress / sqrt(2) + viscosity * shear rate, up to the elastic strain (6e-4 here)."""
    viscosity, rate, dt, limit = 10.0, 1.0, 1e-4, 20.0
    part = ViscousFlow(E=E, nu=NU, viscosity=viscosity, dt=dt, yield_stress=limit)
    velocity_gradient = torch.zeros(3, 3, dtype=torch.float64)
    velocity_gradient[0, 1] = rate
    F = EYE[None].clone()
    for _ in range(400):
        F = part.evaluate((EYE + dt * velocity_gradient) @ F, ())
    expected = limit / 2**0.5 + viscosity * rate
    shear = float(Hencky(E=E, nu=NU).evaluate(F, ())[0, 0, 1])
    assert shear == pytest.approx(expected, rel=4 * (expected / MU + rate * dt))


def test_a_held_bingham_body_relaxes_to_its_yield_stress():
    """|dev tau| - yield_stress = its first value * exp(-mu t / viscosity); the implicit step errs by mu dt / viscosity
    times the exponent, halved."""
    viscosity, dt, limit, steps = 400.0, 1e-4, 1e3, 100
    part, law = ViscousFlow(E=E, nu=NU, viscosity=viscosity, dt=dt, yield_stress=limit), Hencky(E=E, nu=NU)
    F = torch.diag(torch.tensor([1.1, 1.0, 0.95], dtype=torch.float64))[None]

    def excess():
        tau = law.evaluate(F, ())[0]
        return float((tau - tau.trace() / 3 * EYE).norm()) - limit

    first = excess()
    for _ in range(steps):
        F = part.evaluate(F, ())
    rate = MU * dt / viscosity
    assert excess() == pytest.approx(first / (1 + rate) ** steps, rel=1e-9)
    assert excess() == pytest.approx(first * math.exp(-rate * steps), rel=1.01 * rate * (rate * steps) / 2)


def test_limits_of_a_bingham_body():
    """Without viscosity it is von Mises plastic, without yield stress a viscous fluid, with much viscosity elastic."""
    F, stress = deformations(), 5e3

    def returned(viscosity, yield_stress):
        return ViscousFlow(E=E, nu=NU, viscosity=viscosity, dt=1e-3, yield_stress=yield_stress).evaluate(
            F, ()
        )

    plastic = VonMises(E=E, nu=NU, yield_stress=stress).evaluate(F, ())
    torch.testing.assert_close(returned(1e-12, stress), plastic, rtol=1e-9, atol=1e-9)
    fluid = ViscousFlow(E=E, nu=NU, viscosity=20.0, dt=1e-3).evaluate(F, ())
    torch.testing.assert_close(returned(20.0, 1e-9), fluid, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(returned(1e15, stress), F, rtol=1e-9, atol=1e-9)


# ---------------------------------------------------------------------------------------------- adjoints


def smooth_states(name: str) -> torch.Tensor:
    """Deformations, F = I and repeated stretches, without those near a switch of the law (yield, sorting)."""
    F = torch.cat(
        [deformations(60), EYE[None], torch.diag(torch.tensor([1.2, 1.2, 0.8], dtype=torch.float64))[None]]
    )
    if name == "drucker_prager":
        trace, _ = hencky_deviator(F)
        return F[trace[:, 0].abs() > 1e-3]
    return F[:60] if name.startswith("neural") else F


@pytest.mark.parametrize("name", PARTS)
def test_adjoint_against_differences(name):
    part, F = all_parts()[name], smooth_states(name)
    weights = weights_of(part)
    generator = torch.Generator().manual_seed(30)
    direction = torch.randn(F.shape, generator=generator, dtype=F.dtype)
    probe = torch.randn(F.shape, generator=generator, dtype=F.dtype)
    turns = tuple(torch.randn(w.shape, generator=generator, dtype=F.dtype) for w in weights)
    grad_F, grad_weights = part.vjp(F, weights, probe)
    step = 1e-6

    def along(sign: float) -> torch.Tensor:
        moved = tuple(w + sign * step * t for w, t in zip(weights, turns, strict=True))
        return (part.evaluate(F + sign * step * direction, moved) * probe).sum()

    difference = float((along(1) - along(-1)) / (2 * step))
    exact = float(
        (grad_F * direction).sum() + sum((g * t).sum() for g, t in zip(grad_weights, turns, strict=True))
    )
    size = float((grad_F * direction).abs().sum())
    assert abs(difference - exact) < 1e-7 * size


def test_constants_given_as_tensors_are_fitted():
    modulus = torch.tensor(E, dtype=torch.float64, requires_grad=True)
    law = analytic_law(
        {
            "elasticity": {"name": "hencky", "E": modulus, "nu": NU},
            "plasticity": {"name": "von_mises", "yield_stress": 5e3},
        }
    )
    F = deformations(50)
    probe = torch.ones_like(F)
    for part in (law.elasticity, law.plasticity):
        assert part.weights() == (modulus,)
        _, (grad,) = part.vjp(F, part.weights(), probe)
        step = 1.0
        values = [part.evaluate(F, (modulus.detach() + s * step,)).sum() for s in (1, -1)]
        assert float(grad) == pytest.approx(float(values[0] - values[1]) / (2 * step), rel=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["elasticity", "plasticity"])
@pytest.mark.parametrize("count", [1, 33, CPU_ROWS + 5])
def test_network_equals_its_torch_twin(kind, count, dtype):
    """Hand-written forward and adjoint, with and without cache, against autograd through the obvious code."""
    part = getattr(neural_law(seed=2), kind)
    F = deformations(count).to(dtype)
    probe = torch.randn(F.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    weights = weights_of(part, dtype)
    value, cache = part.evaluate_with_cache(F, weights)
    twin_value = part.response(F, weights)
    twin_F, twin_weights = Constitutive.vjp(part, F, weights, probe)
    eps = torch.finfo(dtype).eps
    assert float((value - twin_value).abs().max()) < 64 * eps * float(twin_value.abs().max())
    assert torch.equal(part.evaluate(F, weights), value)
    for kept in (None, cache):
        grad_F, grad_weights = part.vjp(F, weights, probe, cache=kept)
        assert float((grad_F - twin_F).abs().max()) < 256 * eps * float(twin_F.abs().max())
        for grad, twin in zip(grad_weights, twin_weights, strict=True):
            # sums over all rows
            assert float((grad - twin).abs().max()) < 64 * eps * count**0.5 * float(twin.abs().max())


def test_buffers_are_filled_and_weight_gradients_accumulate():
    part = neural_law(seed=2).elasticity
    F, weights = deformations(40), weights_of(part)
    probe = torch.ones_like(F)
    out, grad_F = torch.empty_like(F), torch.empty_like(F)
    totals = tuple(torch.ones_like(w) for w in weights)
    assert part.evaluate(F, weights, out) is out
    plain_F, plain_weights = part.vjp(F, weights, probe)
    returned = part.vjp(F, weights, probe, grad_F=grad_F, grad_weights=totals)
    assert returned[0] is grad_F and returned[1] is totals
    assert torch.equal(grad_F, plain_F)
    for total, grad in zip(totals, plain_weights, strict=True):
        torch.testing.assert_close(total, grad + 1)


def test_caches_are_independent():
    part = neural_law(seed=2).plasticity
    weights, probe = weights_of(part), torch.ones(40, 3, 3, dtype=torch.float64)
    first, second = deformations(40, seed=1), deformations(40, seed=9)
    _, cache = part.evaluate_with_cache(first, weights)
    part.evaluate_with_cache(second, weights)
    assert torch.equal(part.vjp(first, weights, probe, cache=cache)[0], part.vjp(first, weights, probe)[0])


# ---------------------------------------------------------------------------------------------- adaptor


def test_fresh_adaptor_changes_nothing_and_receives_gradients():
    law = neural_law(seed=3)
    before = [w.clone() for w in law.elasticity.weights()]
    law.attach_adaptor(rank=4, alpha=8.0)
    merged = law.elasticity.weights()
    assert all(torch.equal(a, b) for a, b in zip(before, merged, strict=True))
    with torch.no_grad():
        for B in law.elasticity.adaptor.B:
            B.normal_(generator=torch.Generator().manual_seed(0))
    merged = law.elasticity.weights()
    F = deformations(30).float()
    _, grads = law.elasticity.vjp(F, merged, torch.ones_like(F))
    torch.autograd.backward(merged, grads)
    adaptor = law.elasticity.adaptor
    for scale, A, B, G in zip(adaptor.scales, adaptor.A, adaptor.B, grads, strict=True):
        torch.testing.assert_close(B.grad, scale * 2.0 * (G @ A.detach().mT))
        torch.testing.assert_close(A.grad, scale * 2.0 * (B.detach().mT @ G))
    assert all(p.grad is None for p in law.elasticity.base)
    assert all(p.requires_grad for p in adaptor.parameters())


def test_adaptor_scales_with_the_layer():
    base = [torch.randn(s, generator=torch.Generator().manual_seed(0)) for s in SHAPES]
    small, large = Adaptor(base, rank=2), Adaptor([100 * w for w in base], rank=2)
    for a, b in zip(small.scales, large.scales, strict=True):
        assert b == pytest.approx(100 * a, rel=1e-5)
    xavier = (2 * torch.rand(SHAPES[1], generator=torch.Generator().manual_seed(0)) - 1) * (6 / 128) ** 0.5
    assert Adaptor([xavier], rank=2).scales[0] == pytest.approx(1.0, rel=0.05)
    assert Adaptor([torch.zeros(9, 64)], rank=2).scales == [1.0]


@pytest.mark.parametrize("rank", [1, 16, None])
def test_adaptor_state_round_trip_and_interpolation(rank):
    law, copy = neural_law(seed=3), neural_law(seed=3)
    law.attach_adaptor(rank=rank)
    with torch.no_grad():
        for p in (p for p in law.parameters() if p.requires_grad):
            p.normal_(generator=torch.Generator().manual_seed(len(p)))
    copy.load_adaptor_state(law.adaptor_state(), rank=rank)
    for part, other in ((law.elasticity, copy.elasticity), (law.plasticity, copy.plasticity)):
        assert all(torch.equal(a, b) for a, b in zip(part.weights(), other.weights(), strict=True))
    prior, adapted = neural_law(seed=3).elasticity.weights(), law.elasticity.weights()
    law.set_adaptor_weight(0.25)
    for W0, W, half in zip(prior, adapted, law.elasticity.weights(), strict=True):
        torch.testing.assert_close(half, W0 + 0.25 * (W - W0))
    with refused("adaptor.elasticity"):
        copy.load_adaptor_state(law.adaptor_state(), rank=7)


def test_rank_must_be_a_positive_integer():
    with refused("adaptor.rank"):
        neural_law().attach_adaptor(rank=0)


# ------------------------------------------------------------------------------------------ files and specs


def test_prior_files_round_trip(tmp_path):
    law = neural_law(seed=5)
    own = tmp_path / "jelly.safetensors"
    write_weights(own, law.prior_state(), {})
    names = ("layers.0.fc.weight", "layers.1.fc.weight", "final_layer.fc.weight")
    parts = {"elasticity": law.elasticity, "plasticity": law.plasticity}
    content = {k: dict(zip(names, (w.detach() for w in p.weights()), strict=True)) for k, p in parts.items()}
    released = tmp_path / "released.pt"
    torch.save(content, released)
    for path in (own, released):
        loaded = load_prior(path)
        assert loaded.name == path.stem
        for part, other in ((law.elasticity, loaded.elasticity), (law.plasticity, loaded.plasticity)):
            assert all(torch.equal(a, b) for a, b in zip(part.weights(), other.weights(), strict=True))
    assert set(load(own.read_bytes())) == {f"{part}.{name}" for part in parts for name in names}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.pt", None, "does not exist"),
        ("text.pt", b"not a checkpoint", "cannot be read as"),
        ("text.safetensors", b"neither", "cannot be read as"),
        ("weights.npz", b"", "expected .safetensors or .pt"),
        ("list.pt", [1, 2], "expected a dict"),
        ("half.pt", {"elasticity": {}, "plasticity": {}}, "missing"),
        (
            "shapes.pt",
            {
                part: {
                    "layers.0.fc.weight": torch.zeros(64, 12),
                    "layers.1.fc.weight": torch.zeros(64, 64),
                    "final_layer.fc.weight": torch.zeros(9, 64),
                }
                for part in ("elasticity", "plasticity")
            },
            "shapes",
        ),
    ],
)
def test_bad_prior_files_are_named(tmp_path, name, content, message):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(InputError, match=message) as caught:
        load_prior(path)
    assert name in str(caught.value)


@pytest.mark.parametrize(
    ("spec", "where"),
    [
        ({"elasticity": {"name": "henky", "E": 1, "nu": 0.2}}, "elasticity.name"),
        ({"elasticity": {"name": "hencky", "E": 1, "nu": 0.2}, "plastic": {}}, "law"),
        ({}, "law"),
        ({"elasticity": {"name": "hencky", "E": 1, "nu": 0.2, "G": 3}}, "Hencky"),
        ({"elasticity": {"name": "hencky", "E": 1}}, "Hencky.nu"),
        ({"elasticity": {"name": "hencky", "E": -1, "nu": 0.2}}, "Hencky.E"),
        ({"elasticity": {"name": "hencky", "E": "soft", "nu": 0.2}}, "Hencky.E"),
        ({"elasticity": {"name": "hencky", "E": 1, "nu": 0.5}}, "Hencky.nu"),
        (
            {
                "elasticity": {"name": "hencky", "E": 1, "nu": 0.2},
                "plasticity": {"name": "viscous_flow", "viscosity": 1},
            },
            "dt",
        ),
    ],
)
def test_bad_specifications_are_named(spec, where):
    with refused(where):
        analytic_law(spec)


def test_plasticity_shares_or_overrides_the_elastic_constants():
    spec = {
        "elasticity": {"name": "hencky", "E": E, "nu": NU},
        "plasticity": {"name": "von_mises", "yield_stress": 1},
    }
    law = analytic_law(spec)
    assert isinstance(law, Law) and isinstance(law.plasticity, VonMises)
    assert law.plasticity.values["E"] == E
    spec["plasticity"]["E"] = 2e5
    assert analytic_law(spec).plasticity.values["E"] == 2e5


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", PARTS)
def test_cuda_equals_cpu(name, dtype):
    part, F = all_parts()[name], deformations(3000).to(dtype)
    probe = torch.randn(F.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    weights = weights_of(part, dtype)
    on_gpu = tuple(w.cuda() for w in weights)
    value, there = part.evaluate(F, weights), part.evaluate(F.cuda(), on_gpu)
    eps = torch.finfo(dtype).eps
    assert there.is_cuda
    assert float((there.cpu() - value).abs().max()) < 256 * eps * max(
        stiffness(part), float(value.abs().max())
    )
    grad_F, grad_weights = part.vjp(F, weights, probe)
    grad_F_there, grad_weights_there = part.vjp(F.cuda(), on_gpu, probe.cuda())
    # divided differences of nearly equal stretches lose a third of the digits, see principal._apart
    loose = 256 * eps if name.startswith("neural") else 64 * eps ** (2 / 3)
    assert float((grad_F_there.cpu() - grad_F).norm() / grad_F.norm()) < loose
    for grad, other in zip(grad_weights, grad_weights_there, strict=True):
        assert float((other.cpu() - grad).norm() / grad.norm()) < 256 * eps
