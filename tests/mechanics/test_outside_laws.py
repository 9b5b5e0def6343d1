"""The laws that serve as truths outside every candidate family: closed forms, limits, dissipation, bad constants."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import lame
from neuma_lib.mechanics.elasticity import FibreReinforced, Hencky, MooneyRivlin, NeoHookean, Ogden
from neuma_lib.mechanics.plasticity import (
    CohesiveDruckerPrager,
    CrushableFoam,
    HerschelBulkley,
    ViscousFlow,
    VonMises,
    _positive_root,
)
from tests.support.deformations import (
    EYE,
    E,
    assert_adjoint,
    deformations,
    hencky_deviator,
    rotations,
    steady_shear,
)
from tests.support.errors import refused

pytestmark = pytest.mark.core

NU = 0.3
MU, LAM = lame(E, NU)
BULK = LAM + 2 * MU / 3
DT = 1e-4
ROUNDING = torch.finfo(torch.float64).eps
HENCKY = Hencky(E=E, nu=NU)
FOAM = dict(E=E, nu=NU, crush=4e3, tension=1e3, slope=1.2, dt=DT)
SAND = dict(E=E, nu=NU, friction_angle=35.0, cohesion=2e3, dilation_angle=10.0)
PASTE = dict(E=E, nu=NU, consistency=30.0, exponent=0.5, yield_stress=500.0, dt=DT)
RETURNS = {
    "foam": CrushableFoam(**FOAM),
    "foam with rate": CrushableFoam(**FOAM, relaxation=5e-4),
    "sand": CohesiveDruckerPrager(**SAND),
    "sand without dilatancy": CohesiveDruckerPrager(**{**SAND, "dilation_angle": 0.0}),
    "paste": HerschelBulkley(**PASTE),
    "thickening paste": HerschelBulkley(**{**PASTE, "exponent": 2.0}),
}


def diagonal(*stretches: float) -> torch.Tensor:
    return torch.diag(torch.tensor(stretches, dtype=torch.float64))[None]


def pressure_and_q(tau: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    p = -tau.diagonal(dim1=1, dim2=2).mean(1)
    return p, math.sqrt(1.5) * (tau + p[:, None, None] * EYE).norm(dim=(1, 2))


# ---------------------------------------------------------------------------------------------- elasticity


@pytest.mark.parametrize(
    "law",
    [Ogden(E=E, nu=NU, alpha=12.0), MooneyRivlin(E=E, nu=NU, q=0.8)],
    ids=lambda law: type(law).__name__,
)
def test_at_small_strains_they_are_hencky(law):
    """The difference is of second order: a tenth of the strain leaves a hundredth of it."""
    direction = deformations(50, 0.1) - rotations(50, 2)
    gaps = []
    for size in (1e-3, 1e-4):
        F = EYE + size * direction
        gaps.append(float((law.evaluate(F, ()) - HENCKY.evaluate(F, ())).norm()))
    assert gaps[1] == pytest.approx(gaps[0] / 100, rel=0.05)


def test_ogden_at_two_is_isochoric_neo_hookean_and_near_zero_hencky():
    F = deformations()
    neo = MooneyRivlin(E=E, nu=NU, q=0.0).evaluate(F, ())
    torch.testing.assert_close(Ogden(E=E, nu=NU, alpha=2.0).evaluate(F, ()), neo, rtol=1e-12, atol=1e-10 * E)
    least = 1e-4
    gap = Ogden(E=E, nu=NU, alpha=least).evaluate(F, ()) - HENCKY.evaluate(F, ())
    strain = float(F.pow(2).sum((1, 2)).max()) / 2
    assert (
        float(gap.abs().max()) < least * 2 * MU * strain**2
    )  # exp(alpha e) / alpha - e = alpha e^2 / 2 + ...
    isochoric = F / torch.linalg.det(F)[:, None, None] ** (1 / 3)
    neo = NeoHookean(E=E, nu=NU).evaluate(isochoric, ())  # there its deviator is mu dev b as well
    spherical = neo.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * EYE
    mooney = MooneyRivlin(E=E, nu=NU, q=0.0).evaluate(isochoric, ())
    torch.testing.assert_close(mooney, neo - spherical, rtol=1e-10, atol=1e-10 * E)


@pytest.mark.parametrize("a", [0.5, 0.8, 1.3, 2.0])
def test_bar_of_constant_volume(a):
    """Cauchy stress of a free bar, tau_1 - tau_2 at J = 1: Ogden's power law, and Rivlin's
    2 (C1 + C2 / a) (a^2 - 1 / a)."""
    F = diagonal(a, a**-0.5, a**-0.5)
    ogden = Ogden(E=E, nu=NU, alpha=9.0).evaluate(F, ())[0]
    assert float(ogden[0, 0] - ogden[1, 1]) == pytest.approx(2 * MU / 9 * (a**9 - a**-4.5), rel=1e-10)
    C1, C2 = 0.2 * MU / 2, 0.8 * MU / 2
    mooney = MooneyRivlin(E=E, nu=NU, q=0.8).evaluate(F, ())[0]
    assert float(mooney[0, 0] - mooney[1, 1]) == pytest.approx(2 * (C1 + C2 / a) * (a * a - 1 / a), rel=1e-10)


def test_ogden_stiffens_threefold_at_a_stretch_of_1_16():
    """Tangent of pure shear diag(s, 1/s, 1) over that at rest: (s^12 + s^-12) / 2, in log s."""
    law, stretch, step = Ogden(E=E, nu=NU, alpha=12.0), 1.16, 1e-6
    logs = [math.log(s) + sign * step for s in (stretch, 1.0) for sign in (1, -1)]
    tau = [
        float(t[0, 0] - t[1, 1])
        for t in (law.evaluate(diagonal(math.exp(e), math.exp(-e), 1), ())[0] for e in logs)
    ]
    ratio = (tau[0] - tau[1]) / (tau[2] - tau[3])
    assert ratio == pytest.approx((stretch**12 + stretch**-12) / 2, rel=1e-6) and ratio > 3


def fibres(azimuth=30.0, elevation=20.0) -> FibreReinforced:
    return FibreReinforced(
        E=E, nu=NU, fibre_modulus=3e5, fibre_exponent=2.0, azimuth=azimuth, elevation=elevation
    )


def axis(azimuth: float, elevation: float) -> torch.Tensor:
    turn, rise = math.radians(azimuth), math.radians(elevation)
    flat = math.cos(rise)
    return torch.tensor([flat * math.cos(turn), math.sin(rise), flat * math.sin(turn)], dtype=torch.float64)


def test_pull_along_and_across_the_fibres():
    """F = 1 + (s - 1) n (x) n: along them Hencky and H / 2 (s^2 - 1) exp(b (s^2 - 1)^2) s^2, across them Hencky."""
    a = axis(30.0, 20.0)
    across = torch.linalg.cross(a, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    across = across / across.norm()
    for s in (0.9, 1.05, 1.2):
        green = s * s - 1
        for n, fibre in ((a, 1.5e5 * green * math.exp(2 * green**2) * s * s), (across, 0.0)):
            nn = torch.outer(n, n)
            tau = fibres().evaluate((EYE + (s - 1) * nn)[None], ())[0]
            expected = LAM * math.log(s) * EYE + (2 * MU * math.log(s) + fibre) * nn
            torch.testing.assert_close(tau, expected, rtol=1e-11, atol=1e-11 * E)


def test_fibres_break_isotropy_and_rotate_with_the_body():
    F, Q = deformations(), rotations(400, 21)
    law = fibres()
    tau = law.evaluate(F, ())
    assert float((law.evaluate(F @ Q, ()) - tau).abs().max()) > E  # not isotropic
    # about the fibres it is, and a body turned before it is strained has turned fibres
    a, turn = axis(30.0, 20.0), torch.tensor(0.7, dtype=torch.float64)
    K = torch.linalg.cross(EYE, a.expand(3, 3)).mT
    about = EYE + turn.sin() * K + (1 - turn.cos()) * K @ K
    torch.testing.assert_close(about @ a, a)
    size = float(tau.abs().max())
    assert float((law.evaluate(F @ about, ()) - tau).abs().max()) < 64 * ROUNDING * size
    quarter = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]], dtype=torch.float64)  # azimuth + 90 degrees
    turned = fibres(azimuth=120.0).evaluate(F @ quarter.mT, ())
    assert float((turned - tau).abs().max()) < 64 * ROUNDING * size


def test_without_fibres_the_matrix_remains():
    law = FibreReinforced(E=E, nu=NU, fibre_modulus=0.0, fibre_exponent=2.0)
    assert torch.equal(law.evaluate(deformations(), ()), HENCKY.evaluate(deformations(), ()))


# ---------------------------------------------------------------------------------------------- plasticity


@pytest.mark.parametrize("name", RETURNS)
def test_returns_dissipate(name):
    """Stress after the return times the plastic strain, tau : (eps_trial - eps) = sum_i tau_i de_i, is never negative
    (coaxial), nor is the elastic energy given off."""
    F = torch.cat(
        [deformations(), deformations(size=0.02), deformations() * 0.97, deformations(size=0.02) * 1.03]
    )
    part = RETURNS[name]
    stretched = torch.linalg.svdvals(F).log()
    strain = torch.linalg.svdvals(part.evaluate(F, ())).log()
    tau = 2 * MU * strain + LAM * strain.sum(1, keepdim=True)
    work = (tau * (stretched - strain)).sum(1)
    assert int((work > 1e-6 * E).sum()) > 400
    assert float(work.min()) > -64 * ROUNDING * float(tau.abs().max())

    def energy(e):
        return MU * (e**2).sum(1) + LAM / 2 * e.sum(1) ** 2

    assert bool((energy(strain) <= energy(stretched) * (1 + 64 * ROUNDING)).all())


@pytest.mark.parametrize("name", ["foam", "sand", "sand without dilatancy"])
def test_a_second_return_changes_nothing(name):
    once = RETURNS[name].evaluate(deformations(), ())
    twice = RETURNS[name].evaluate(once, ())
    assert float((twice - once).abs().max()) < 256 * ROUNDING * (1 + LAM / MU)


@pytest.mark.parametrize("name", RETURNS)
def test_inside_the_surface_nothing_changes(name):
    F = deformations(size=1e-4)
    assert torch.equal(RETURNS[name].evaluate(F, ()), F)


def test_foam_returns_to_its_ellipse():
    F = deformations()
    p, q = pressure_and_q(HENCKY.evaluate(RETURNS["foam"].evaluate(F, ()), ()))
    centre, half = 1.5e3, 2.5e3
    height = ((p - centre) / half) ** 2 + (q / (1.2 * half)) ** 2
    moved = (RETURNS["foam"].evaluate(F, ()) != F).any(2).any(1)
    assert int(moved.sum()) > 300 and float((height[moved] - 1).abs().max()) < 1e-10
    assert float(height.max()) < 1 + 1e-10


@pytest.mark.parametrize("relaxation", [0.0, 5e-3])
def test_hydrostatic_compaction_of_foam(relaxation):
    """Compacted at the rate d: elastic to the crush pressure, then p = crush + K d t (1 - exp(-(e - e_0) / (d t))) with
    the relaxation time t; unloaded, the volume does not come back. First order in the step."""
    part = CrushableFoam(**FOAM, relaxation=relaxation)
    rate, steps = 4.0, 300  # a log volume strain of 0.12, of which 0.048 are elastic
    F, overstress = EYE[None].clone(), BULK * rate * relaxation
    for _ in range(steps):
        F = part.evaluate(math.exp(-rate * DT / 3) * F, ())
    beyond = rate * DT * steps - 4e3 / BULK
    expected = 4e3 + (overstress * (1 - math.exp(-beyond / (rate * relaxation))) if relaxation else 0.0)
    p, q = pressure_and_q(HENCKY.evaluate(F, ()))
    # one step's error of the exponential and of the moment of yield
    assert float(p) == pytest.approx(expected, abs=BULK * rate * DT if relaxation else 1e-9 * E)
    assert float(q) < 1e-9 * E
    lost = rate * DT * steps + float(torch.linalg.det(F).log())
    assert lost == pytest.approx(rate * DT * steps - float(p) / BULK, rel=1e-9) and lost > 0.04


@pytest.mark.parametrize("exponent", [0.3, 0.5, 1.0, 1.8])
def test_steady_shear_of_herschel_bulkley(exponent):
    """tau_xy = yield_stress / sqrt(2) + k g^m to first order in the elastic strain and the step's strain."""
    rate, consistency, yield_stress = 3.0, 10.0, 14.0
    part = HerschelBulkley(
        E=E, nu=NU, consistency=consistency, exponent=exponent, yield_stress=yield_stress, dt=DT
    )
    F = steady_shear(part, rate, DT)
    expected = yield_stress / math.sqrt(2) + consistency * rate**exponent
    strain = expected / MU
    assert float(HENCKY.evaluate(F, ())[0, 0, 1]) == pytest.approx(expected, rel=4 * (strain + rate * DT))


def test_herschel_bulkley_contains_bingham():
    F = deformations()
    paste = HerschelBulkley(**{**PASTE, "exponent": 1.0})
    bingham = ViscousFlow(E=E, nu=NU, viscosity=30.0, yield_stress=500.0, dt=DT)
    torch.testing.assert_close(paste.evaluate(F, ()), bingham.evaluate(F, ()), rtol=1e-12, atol=1e-13)


def test_newton_reaches_round_off():
    """Over the exponents admitted and 24 decades of the other two: the equation holds."""
    for exponent in torch.linspace(0.2, 3.0, 29).tolist():
        total = torch.logspace(-20, 1, 43, dtype=torch.float64)[:, None]
        for rate in torch.logspace(-12, 12, 25, dtype=torch.float64).tolist():
            y = _positive_root(rate, 1 / exponent, total)
            residual = (y + rate * y ** (1 / exponent)) / total - 1
            # u = log y is kept to round-off relative to its size, up to log(1e30), and raised to the power
            assert float(residual.abs().max()) < 1e-11, (exponent, rate)


def test_constants_of_the_paste_are_differentiated():
    constants = {k: torch.tensor(v, dtype=torch.float64, requires_grad=k != "dt") for k, v in PASTE.items()}
    assert_adjoint(HerschelBulkley(**constants), deformations(40))


@pytest.mark.parametrize("pressure", [0.0, 3e3, 2e4])
def test_strength_of_sand_under_pressure(pressure):
    """A sample held at a mean pressure and compressed along an axis yields at q = 6 (c cos + p sin) / (3 - sin), and
    volume grows with shear by the dilation angle."""
    part, sine = CohesiveDruckerPrager(**SAND), math.sin(math.radians(35))
    strength = 6 * (2e3 * math.cos(math.radians(35)) + pressure * sine) / (3 - sine)
    shape = torch.tensor([-2.0, 1.0, 1.0], dtype=torch.float64)

    def trial(q: float) -> torch.Tensor:
        return torch.diag((shape * q / (6 * MU) - pressure / (3 * BULK)).exp())[None]

    held, torn = trial(strength * (1 - 1e-9)), trial(strength * 1.5)
    assert torch.equal(part.evaluate(held, ()), held)
    returned = part.evaluate(torn, ())
    p, q = pressure_and_q(HENCKY.evaluate(returned, ()))
    assert float(q) == pytest.approx(
        6 * (2e3 * math.cos(math.radians(35)) + float(p) * sine) / (3 - sine), rel=1e-9
    )
    before, after = hencky_deviator(torn), hencky_deviator(returned)
    slide, growth = float((before[1] - after[1]).norm()), float(before[0] - after[0])
    dilation = math.sin(math.radians(10))
    assert growth == pytest.approx(3 * math.sqrt(2 / 3) * 2 * dilation / (3 - dilation) * slide, rel=1e-9)


def test_cohesion_bears_hydrostatic_tension():
    """Up to the cone's apex, p = -c / tan(friction angle)."""
    limit = 2e3 / math.tan(math.radians(35)) / (3 * BULK)
    part = CohesiveDruckerPrager(**SAND)
    held, torn = (EYE * math.exp(0.99 * limit))[None], (EYE * math.exp(1.5 * limit))[None]
    assert torch.equal(part.evaluate(held, ()), held)
    torch.testing.assert_close(part.evaluate(torn, ()), (EYE * math.exp(limit))[None])


def test_foam_loses_volume_and_von_mises_does_not():
    F = diagonal(0.8, 0.8, 0.8)
    kept = VonMises(E=E, nu=NU, yield_stress=1e3).evaluate(F, ())
    assert torch.equal(kept, F)
    assert float(torch.linalg.det(RETURNS["foam"].evaluate(F, ()))) > float(torch.linalg.det(F)) * 1.5


# ------------------------------------------------------------------------------------------------ scenes


def smallest_misfit(target: np.ndarray, curves: list[np.ndarray]) -> float:
    """Relative residual of the best sum of the curves with factors >= 0."""
    return nnls(np.stack(curves, axis=1), target)[1] / float(np.linalg.norm(target))


@pytest.mark.parametrize(
    ("scene", "first", "last"), [("OutsideStiffening", 1.0, 1.3), ("OutsideRubber", 0.55, 1.6)]
)
def test_no_shear_modulus_fits_the_elastic_scenes(loaded, scene, first, last):
    """tau_1 - tau_2 of a bar of constant volume, over the stretches that the scene sees: a candidate has one factor."""
    stretch = torch.linspace(first, last, 40, dtype=torch.float64)
    F = torch.diag_embed(torch.stack([stretch, stretch**-0.5, stretch**-0.5], dim=1))

    def curve(elasticity) -> np.ndarray:
        tau = analytic_law({"elasticity": elasticity}).elasticity.evaluate(F, ())
        return (tau[:, 0, 0] - tau[:, 1, 1]).numpy()

    truth = curve(loaded.scene(scene).law.elasticity.plain())
    for family in loaded.identify.families.values():
        assert smallest_misfit(truth, [curve(family.elasticity.plain())]) > 0.2


def test_no_bingham_line_fits_the_paste_scene(loaded):
    """Shear stress over shear rates of 2 to 30 per second."""
    law = loaded.scene("OutsidePaste").law.plasticity.plain()
    rate = np.linspace(2, 30, 40)
    stress = law["yield_stress"] / math.sqrt(2) + law["consistency"] * rate ** law["exponent"]
    assert smallest_misfit(stress, [np.ones(40), rate]) > 0.2


def test_no_candidate_returns_like_the_plastic_scenes(loaded):
    """Foam loses volume under pressure. Damp sand bears tension, rubs, and grows where it slides: each return of a
    candidate keeps the volume where it bears any tension."""

    def part(law, dt):
        return analytic_law(law.plain(), dt=dt).plasticity

    foam, sand = (loaded.scene(name) for name in ("OutsideFoam", "OutsideDampSand"))
    pressed = diagonal(0.8, 0.8, 0.8)
    slid = diagonal(1.04, 1 / 1.04, 1.0)
    assert float(torch.linalg.det(part(foam.law, foam.dt).evaluate(pressed, ()))) > 0.6
    # elastic volume falls under shear at none: the body grows by as much
    assert float(torch.linalg.det(part(sand.law, sand.dt).evaluate(slid, ()))) < 0.99
    for family in loaded.identify.families.values():
        back = part(family, 5e-4)
        assert float(torch.linalg.det(back.evaluate(pressed, ()))) == pytest.approx(0.512)
        after = back.evaluate(slid, ())
        torn = torch.equal(after, EYE[None])  # dry sand, which bears no tension
        assert torn or float(torch.linalg.det(after)) == pytest.approx(1.0)


def test_fibres_of_the_scene_lie_askew_and_bear_most(loaded):
    law = loaded.scene("OutsideFibres").law.elasticity
    constants = law.plain()
    assert 20 <= constants["elevation"] <= 30
    assert constants["fibre_modulus"] > 5 * constants["E"]


# ------------------------------------------------------------------------------------------------ mistakes


@pytest.mark.parametrize(
    ("law", "constants", "key"),
    [
        (Ogden, dict(E=E, nu=NU), "alpha"),
        (Ogden, dict(E=E, nu=NU, alpha=-2), "alpha"),
        (MooneyRivlin, dict(E=E, nu=NU, q=1.5), "q"),
        (FibreReinforced, dict(E=E, nu=NU, fibre_modulus=1, fibre_exponent=1, elevation=120), "elevation"),
        (CrushableFoam, {**FOAM, "tension": 0.0}, "tension"),
        (HerschelBulkley, {**PASTE, "exponent": 0.05}, "exponent"),
        (CohesiveDruckerPrager, {**SAND, "dilation_angle": 40.0}, "dilation_angle"),
        (CohesiveDruckerPrager, {**SAND, "cohesion": -1.0}, "cohesion"),
    ],
)
def test_bad_constants_are_named(law, constants, key):
    with refused(f"{law.__name__}.{key}"):
        law(**constants)
