"""Constitutive laws: closed forms, invariances, yield surfaces, adjoints, files."""

import math

import pytest
import torch
from safetensors.torch import load

from neuma_lib.errors import InputError
from neuma_lib.io.laws import load_prior
from neuma_lib.io.weights import write_weights
from neuma_lib.mechanics.adaptor import LAYER_KEYS, Adaptor
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import lame
from neuma_lib.mechanics.elasticity import ELASTICITIES, Hencky, Tait
from neuma_lib.mechanics.law import Constitutive, Law
from neuma_lib.mechanics.neural import SHAPES, neural_law
from neuma_lib.mechanics.plasticity import (
    DruckerPrager,
    FluidProjection,
    ViscousFlow,
    VonMises,
    hencky_strain,
)
from tests.support import structured_laws as structured
from tests.support.deformations import (
    EYE,
    NU,
    E,
    assert_adjoint,
    deformations,
    hencky_deviator,
    randomise_adaptor,
    rotations,
    steady_shear,
    stiffness,
    weights_of,
)
from tests.support.errors import refused

pytestmark = pytest.mark.core

MU, LAM = lame(E, NU)
FURTHER_CONSTANTS = {
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
    return {"name": name, "E": E, "nu": NU, **FURTHER_CONSTANTS.get(name, {})}


def elasticity(name: str):
    return analytic_law({"elasticity": elastic_spec(name)}).elasticity


def plasticity(name: str):
    spec = {
        "elasticity": {"name": "hencky", "E": E, "nu": NU},
        "plasticity": {"name": name, **PLASTICITIES[name]},
    }
    return analytic_law(spec, dt=1e-3).plasticity


STRUCTURED_STRESS = [f"{base} {form} {seed}" for base, form in structured.ELASTIC for seed in range(3)]
STRUCTURED_RETURN = [f"{name} {seed}" for name in structured.RETURNS for seed in range(3)]
STRUCTURED = STRUCTURED_STRESS + STRUCTURED_RETURN
PARTS = [*ELASTICITIES, *PLASTICITIES, "neural elasticity", "neural plasticity"]
STRESSES = [*ELASTICITIES, "neural elasticity", *STRUCTURED_STRESS]
RETURNS = [*PLASTICITIES, "neural plasticity", *STRUCTURED_RETURN]
DTYPES = torch.float32, torch.float64


def part_of(name: str) -> Constitutive:
    """An analytic law, a random network, the elastic one adapted, or a structured law with random weights."""
    if name in ELASTICITIES:
        return elasticity(name)
    if name in PLASTICITIES:
        return plasticity(name)
    *words, last = name.split()
    if last.isdigit():
        part = structured.elasticity(*words) if len(words) == 2 else structured.plasticity(*words)
        part.freeze(structured.random_weights(part, int(last)))
        return part
    law = neural_law(seed=4)
    law.attach_adaptor(rank=4)
    with torch.no_grad():
        for parameter in law.elasticity.adaptor.parameters():
            parameter.add_(0.1)
    return getattr(law, last)


def evaluate(part: Constitutive, F: torch.Tensor) -> torch.Tensor:
    return part.evaluate(F, weights_of(part, F.dtype))


# ------------------------------------------------------------------------------------------- closed forms


def textbook_stress(name: str, F: torch.Tensor) -> torch.Tensor:
    """Kirchhoff stress (N, 3, 3) by the tensor form of each law, through eigenvectors of b = F F^T."""
    b, J = F @ F.mT, torch.linalg.det(F)[:, None, None]
    squares, axes = torch.linalg.eigh(b)

    def of_stretch(function):
        return axes @ torch.diag_embed(function(squares.sqrt())) @ axes.mT

    def deviator(A):
        return A - A.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * EYE

    strain, isochoric, bulk = of_stretch(torch.log), b * J ** (-2 / 3), LAM + 2 * MU / 3
    hencky = 2 * MU * strain + LAM * J.log() * EYE
    if name == "fixed_corotated":  # P = 2 mu (F - R) + lam (J - 1) J F^-T
        R = of_stretch(torch.reciprocal) @ F
        return 2 * MU * (F - R) @ F.mT + LAM * J * (J - 1) * EYE
    if name == "stvk":  # S = 2 mu G + lam tr(G) I, tau = F S F^T
        green = (F.mT @ F - EYE) / 2
        trace = green.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
        return F @ (2 * MU * green + LAM * trace * EYE) @ F.mT
    if name == "hencky":
        return hencky
    if name == "tait":
        return bulk / 7 * (J - J**-6) * EYE + 2 * MU * deviator(strain)
    if name == "neo_hookean":
        return MU * (b - EYE) + LAM * J.log() * EYE
    if name == "ogden":  # alpha = 6
        return 2 * MU / 6 * deviator(isochoric @ isochoric @ isochoric) + bulk * J.log() * EYE
    if name == "mooney_rivlin":  # q = 0.7
        shear = 0.3 * deviator(isochoric) - 0.7 * deviator(torch.linalg.inv(isochoric))
        return MU * shear + bulk * J.log() * EYE
    if name == "fibre_reinforced":  # Hencky, and fibres along x
        a = F[:, :, 0]
        green = (a * a).sum(1)[:, None, None] - 1
        return hencky + 1e5 * green * (1.5 * green**2).clamp(max=8).exp() * a[:, :, None] * a[:, None]
    return LAM * J * (J - 1) * EYE


@pytest.mark.parametrize("name", ELASTICITIES)
def test_stress_is_the_textbook_form(name):
    """In uniaxial strain, in simple shear, and for random deformations."""
    F = EYE.repeat(9, 1, 1)
    F[:5, 0, 0] = torch.tensor([0.6, 0.95, 1.0, 1.05, 1.7])
    F[5:, 0, 1] = torch.tensor([-0.4, 0.01, 0.3, 1.5])
    F = torch.cat([F, deformations(50)])
    tau = elasticity(name).evaluate(F, ())
    torch.testing.assert_close(tau, textbook_stress(name, F), rtol=1e-12, atol=1e-12 * E)


@pytest.mark.parametrize("name", ELASTICITIES)
def test_wave_speed_is_that_of_linear_elasticity(name):
    law = analytic_law({"elasticity": elastic_spec(name)})
    modulus = (
        LAM if name == "fluid" else LAM + 2 * MU + FURTHER_CONSTANTS.get(name, {}).get("fibre_modulus", 0)
    )
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


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", PARTS + STRUCTURED)
def test_objectivity(name, dtype):
    """tau(QF) = Q tau(F) Q^T and F_new(QF) = Q F_new(F), to the rounding of the inputs."""
    part = part_of(name)
    F, Q = deformations().to(dtype), rotations(400, 20).to(dtype)
    turned = evaluate(part, Q @ F)
    expected = Q @ evaluate(part, F) @ (Q.mT if name in STRESSES else torch.eye(3, dtype=dtype))
    tolerance = 64 * torch.finfo(dtype).eps * max(stiffness(part), float(expected.abs().max()))
    assert float((turned - expected).abs().max()) < tolerance


@pytest.mark.parametrize(
    ("name", "dtype"),
    [(name, torch.float64) for name in PARTS if not name.startswith(("neural", "fibre"))]
    + [(name, dtype) for name in STRUCTURED for dtype in DTYPES],
)
def test_laws_without_directions_are_isotropic(name, dtype):
    part = part_of(name)
    F, Q = deformations().to(dtype), rotations(400, 21).to(dtype)
    expected = evaluate(part, F) if name in STRESSES else evaluate(part, F) @ Q
    tolerance = 64 * torch.finfo(dtype).eps * max(stiffness(part), float(expected.abs().max()))
    assert float((evaluate(part, F @ Q) - expected).abs().max()) < tolerance


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", STRESSES)
def test_rotation_is_free_of_stress(name, dtype):
    part = part_of(name)
    tau = evaluate(part, rotations(300, 22).to(dtype))
    assert float(tau.abs().max()) < 32 * torch.finfo(dtype).eps * stiffness(part)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", RETURNS)
def test_plasticity_preserves_rotations(name, dtype):
    """A learned friction may yield at rest, but there is nothing to return."""
    part, Q = part_of(name), rotations(300, 22).to(dtype)
    size = max(stiffness(part), 1.0) if name in STRUCTURED else 1.0
    assert float((evaluate(part, Q) - Q).abs().max()) < 32 * torch.finfo(dtype).eps * size


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", [*ELASTICITIES, *STRUCTURED_STRESS])
def test_stress_is_symmetric(name, dtype):
    tau = evaluate(part_of(name), deformations().to(dtype))
    assert float((tau - tau.mT).abs().max()) < 8 * torch.finfo(dtype).eps * float(tau.abs().max())


@pytest.mark.parametrize("name", PARTS + STRUCTURED)
def test_finite_for_crushed_and_inverted_elements(name):
    part = part_of(name)
    F = EYE.repeat(5, 1, 1)
    F[0, 1, 1], F[1, 2, 2], F[4, 0, 0] = 1e-4, -0.3, 0.05
    F[2] *= 0
    F[3] *= 5
    for dtype in DTYPES:
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


@pytest.mark.parametrize("limit", [0.0, 20.0])
def test_viscous_flow_is_a_bingham_fluid_in_steady_shear(limit):
    """tau_xy = yield_stress / sqrt(2) + viscosity * shear rate, up to the elastic strain (6e-4 here)."""
    viscosity, rate, dt = 10.0, 1.0, 1e-4
    part = ViscousFlow(E=E, nu=NU, viscosity=viscosity, dt=dt, yield_stress=limit)
    expected = limit / 2**0.5 + viscosity * rate
    shear = float(Hencky(E=E, nu=NU).evaluate(steady_shear(part, rate, dt), ())[0, 0, 1])
    assert shear == pytest.approx(expected, rel=4 * (expected / MU + rate * dt))


def test_a_projected_tait_fluid_knows_its_volume_alone():
    """PAC-NeRF's weakly compressible fluid without viscosity: kappa (J - J^-6) I, whatever the deformation."""
    F = deformations(50)
    part, law = FluidProjection(), Tait(E=E, nu=NU)
    J = torch.linalg.det(F)[:, None, None]
    expected = (LAM + 2 * MU / 3) / 7 * (J - J**-6) * EYE
    torch.testing.assert_close(law.evaluate(part.evaluate(F, ()), ()), expected, rtol=1e-10, atol=1e-10 * E)


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
    if name.endswith("4"):  # structured
        F = structured.near_states()
        if (
            name.split()[0] in structured.RETURNS
        ):  # away from the tip of the cone, where rest lies, and from yield
            trace, _, norm = hencky_strain(torch.linalg.svdvals(F))
            F = F[(trace[:, 0].abs() > 1e-3) & (norm[:, 0] > 1e-3)]
        return F
    F = torch.cat(
        [deformations(60), EYE[None], torch.diag(torch.tensor([1.2, 1.2, 0.8], dtype=torch.float64))[None]]
    )
    if name == "drucker_prager":
        trace, _ = hencky_deviator(F)
        return F[trace[:, 0].abs() > 1e-3]
    return F[:60] if name.startswith("neural") else F


@pytest.mark.parametrize(
    "name",
    [
        *PARTS,
        *(f"{base} {form} 4" for base, form in structured.ELASTIC),
        *(f"{r} 4" for r in structured.RETURNS),
    ],
)
def test_adjoint_against_differences(name):
    assert_adjoint(part_of(name), smooth_states(name))


def test_constants_given_as_tensors_are_fitted():
    modulus = torch.tensor(E, dtype=torch.float64, requires_grad=True)
    von_mises = {"name": "von_mises", "yield_stress": 5e3}
    law = analytic_law({"elasticity": {"name": "hencky", "E": modulus, "nu": NU}, "plasticity": von_mises})
    for part in (law.elasticity, law.plasticity):
        assert part.weights() == (modulus,)
        assert_adjoint(part, deformations(50))


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
        rounding = 8 * torch.finfo(G.dtype).eps * scale * 2.0 * float(B.detach().norm() * G.norm())
        torch.testing.assert_close(A.grad, scale * 2.0 * (B.detach().mT @ G), rtol=1e-5, atol=rounding)
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
    randomise_adaptor(law, size=1.0)
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


def test_names_of_layers_are_those_of_the_released_files():
    assert LAYER_KEYS == ("layers.0.fc.weight", "layers.1.fc.weight", "final_layer.fc.weight")


def test_prior_files_round_trip(tmp_path):
    law = neural_law(seed=5)
    own = tmp_path / "jelly.safetensors"
    write_weights(own, law.prior_state(), {})
    parts = {"elasticity": law.elasticity, "plasticity": law.plasticity}
    content = {
        k: dict(zip(LAYER_KEYS, (w.detach() for w in p.weights()), strict=True)) for k, p in parts.items()
    }
    released = tmp_path / "released.pt"
    torch.save(content, released)
    for path in (own, released):
        loaded = load_prior(path)
        assert loaded.name == path.stem
        for part, other in ((law.elasticity, loaded.elasticity), (law.plasticity, loaded.plasticity)):
            assert all(torch.equal(a, b) for a, b in zip(part.weights(), other.weights(), strict=True))
    assert set(load(own.read_bytes())) == {f"{part}.{name}" for part in parts for name in LAYER_KEYS}


NARROW = dict(zip(LAYER_KEYS, map(torch.zeros, ((64, 12), (64, 64), (9, 64))), strict=True))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.pt", None, "does not exist"),
        ("text.pt", b"not a checkpoint", "cannot be read as"),
        ("text.safetensors", b"neither", "cannot be read as"),
        ("weights.npz", b"", "expected .safetensors or .pt"),
        ("list.pt", [1, 2], "expected a dict"),
        ("half.pt", {"elasticity": {}, "plasticity": {}}, "missing"),
        ("shapes.pt", dict.fromkeys(("elasticity", "plasticity"), NARROW), "shapes"),
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
        ({"elasticity": {"name": "hencky", "E": 1, "nu": 0.2}, "plastic": {}}, "law"),
        ({"elasticity": {"name": "hencky", "E": 1, "nu": 0.2, "G": 3}}, "Hencky"),
        ({"elasticity": {"name": "hencky", "E": 1}}, "Hencky.nu"),
        ({"elasticity": {"name": "hencky", "E": -1, "nu": 0.2}}, "Hencky.E"),
        ({"elasticity": {"name": "hencky", "E": "soft", "nu": 0.2}}, "Hencky.E"),
        ({"elasticity": {"name": "hencky", "E": 1, "nu": 0.5}}, "Hencky.nu"),
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
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", PARTS)
def test_cuda_equals_cpu(name, dtype):
    part, F = part_of(name), deformations(3000).to(dtype)
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
