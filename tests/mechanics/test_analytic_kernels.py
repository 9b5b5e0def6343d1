"""The kernels of the analytic laws agree with their torch twin and with differences. On a CPU the CUDA source runs in
an emulation."""

import logging
import time
from pathlib import Path

import pytest
import torch
import warp as wp

from neuma_lib.mechanics import analytic_kernels as kernels
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.analytic_kernels import COEFFICIENTS, LAWS
from neuma_lib.mechanics.elasticity import ELASTICITIES, AnalyticElasticity, Hencky
from neuma_lib.mechanics.fused_launch import launch_blocks
from neuma_lib.mechanics.law import Constitutive, Law
from neuma_lib.mechanics.plasticity import PLASTICITIES, Identity
from neuma_lib.mechanics.side_by_side import side_by_side
from neuma_lib.sim import rollout as rollouts
from neuma_lib.sim.model import MPM
from tests.support.deformations import EYE, NU, E, deformations, hencky_deviator, rotations
from tests.support.emulated_cuda import COMPILER, EmulatedAnalyticLaws
from tests.support.fused_laws import assert_can_be_captured, distance, fast, probe, twin
from tests.support.sim_scenes import moving_cube

pytestmark = pytest.mark.core

DTYPES = torch.float32, torch.float64
ELASTIC = {
    **dict.fromkeys(["fixed_corotated", "stvk", "hencky", "neo_hookean", "fluid", "tait"], {}),
    "ogden": {"alpha": 6.0},
    "mooney_rivlin": {"q": 0.7},
    "fibre_reinforced": {"fibre_modulus": 2e5, "fibre_exponent": 1.5, "azimuth": 20.0, "elevation": 30.0},
}
PLASTIC = {
    "identity": {},
    "von_mises": {"yield_stress": 1e4},
    "drucker_prager": {"friction_angle": 25.0, "cohesion": 0.01},
    "fluid_projection": {},
    "viscous_flow": {"viscosity": 30.0, "yield_stress": 1e4},
    "crushable_foam": {"crush": 2e4, "tension": 1e4, "slope": 1.2, "relaxation": 2e-3},
    "herschel_bulkley": {"consistency": 30.0, "exponent": 0.5, "yield_stress": 1e4},
    "cohesive_drucker_prager": {"friction_angle": 35.0, "cohesion": 5e3, "dilation_angle": 10.0},
}
NAMES = [*ELASTIC, *PLASTIC]
YIELDING = [name for name in PLASTIC if name not in ("identity", "fluid_projection")]
FITTED = [name for name in NAMES if name not in ("identity", "fluid_projection")]


def law_of(name: str, scale: float = 1.0) -> Law:
    elastic = {
        "name": name if name in ELASTIC else "hencky",
        "E": scale * E,
        "nu": NU,
        **ELASTIC.get(name, {}),
    }
    plastic = {"name": name if name in PLASTIC else "identity", **PLASTIC.get(name, {})}
    return analytic_law({"elasticity": elastic, "plasticity": plastic}, dt=1e-3)


def part_of(name: str, scale: float = 1.0) -> Constitutive:
    law = law_of(name, scale)
    return law.elasticity if name in ELASTIC else law.plasticity


def fitted(name: str) -> Constitutive:
    """The same law with all its constants as weights."""
    part = part_of(name)
    weights = {k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in part.values.items()}
    return type(part)(**weights)


def states(name: str) -> torch.Tensor:
    """(n, 3, 3): deformations, equal and nearly equal stretches, crushed and inverted elements.

    Those of a return map lie off the edges of its yield surface.
    """
    special = [
        [1.1, 1.1, 0.9],
        [1.1, 0.9, 0.9],
        [0.95, 0.95, 0.95],
        [1.1, 1.1 - 1e-9, 0.9],
        [1.1, 0.9 + 1e-5, 0.9],
        [1.2, 0.9, 0.01],
        [1.2, 0.02, 0.01],
        [1.2, 0.02, 0.02],
        [1.2, 0.02, -0.3],
        [0.9, 0.8, -0.7],
        [3.0, 3.0, 3.0],
    ]
    special = torch.diag_embed(torch.tensor(special, dtype=torch.float64))
    F = torch.cat([deformations(50), rotations(len(special), 6) @ special @ rotations(len(special), 7)])
    return F if name in PLASTIC else torch.cat([F, rotations(5, 8)])


def test_all_built_in_laws_have_kernels():
    laws = {**ELASTICITIES, **PLASTICITIES}
    assert set(NAMES) == {name for name, law in laws.items() if law.__module__.startswith("neuma_lib.")}
    assert {type(part_of(name)).__name__ for name in NAMES} == set(LAWS)
    assert all(part_of(name).native for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_kernels_equal_their_twin(name):
    """The twin has numeric divided differences, with an error of eps^(2/3) times the curvature."""
    part, F = part_of(name), states(name)
    g = probe(F)
    exact = twin(part, F, (), g)
    value, grad_F = fast(part, F, (), g)
    assert distance(value, exact[0]) < 1e-12 and distance(grad_F, exact[1]) < 1e-9
    value, grad_F = fast(part, F.float(), (), g.float())
    exact = twin(part, F.float().double(), (), g)
    assert distance(value, exact[0]) < 1e-6 and distance(grad_F, exact[1]) < 1e-5


@pytest.mark.parametrize("name", YIELDING)
def test_states_are_on_both_sides_of_yield(name):
    unchanged = (part_of(name).evaluate(F := states(name), ()) == F).all(dim=2).all(dim=1)
    assert 2 < int(unchanged.sum()) < len(F) - 10


@pytest.mark.parametrize("name", NAMES)
def test_gradient_of_every_row_is_the_difference(name):
    """Central differences of step h: rounding eps / h, and third derivatives times h^2."""
    part, F, h = part_of(name), states(name), 1e-6
    g = probe(F)
    grad_F, _ = part.vjp(F, (), g)
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        direction = torch.randn(F.shape, generator=generator, dtype=F.dtype)
        ahead, back = ((g * part.evaluate(F + s * h * direction, ())).sum((1, 2)) for s in (1, -1))
        difference, exact = (ahead - back) / (2 * h), (grad_F * direction).sum((1, 2))
        size = grad_F.norm(dim=(1, 2)) + g.norm(dim=(1, 2)) * part.evaluate(F, ()).norm(dim=(1, 2))
        assert float(((difference - exact).abs() / size).max()) < 1e-7


@pytest.mark.parametrize("name", FITTED)
def test_gradients_of_constants_equal_the_twin(name):
    part, F = fitted(name), states(name)
    g, weights = probe(F), part.weights()
    assert len(weights) == len(part.constants)
    expected, actual = twin(part, F, weights, g)[2:], fast(part, F, weights, g)[2:]
    for constant, value, exact in zip(part.constants, actual, expected, strict=True):
        size = part.evaluate(F, weights).norm() * g.norm() / abs(float(part.values[constant].detach()))
        assert abs(float(value - exact)) < 1e-11 * float(size), constant
    # over many calls
    totals = tuple(torch.ones_like(w) for w in weights)
    sums = part.accumulators(F, totals)
    for _ in range(2):
        part.vjp(F, weights, g, grad_weights=sums)
    part.add_up(sums, weights, totals)
    for total, value in zip(totals, actual, strict=True):
        torch.testing.assert_close(total - 1, 2 * value, rtol=1e-12, atol=1e-12)


def test_constants_that_change_in_place_are_noticed():
    part, F = fitted("hencky"), states("hencky")
    before = part.evaluate(F, part.weights())
    with torch.no_grad():
        part.weights()[0].mul_(2)
    torch.testing.assert_close(part.evaluate(F, part.weights()), 2 * before, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", NAMES)
def test_cache_and_buffers_change_no_bit(name, dtype):
    part = part_of(name)
    for count in (1, 8, 17, 33, 0):
        F = states(name)[:count].to(dtype)
        g = probe(F)
        value, grad_F = fast(part, F, (), g)
        out, into = (torch.full((count, 6, 3), torch.nan, dtype=dtype)[:, ::2] for _ in range(2))
        result, cache = part.evaluate_with_cache(F, (), out)
        assert result is out and torch.equal(out, value)
        assert part.evaluate_with_cache(F, (), cache=cache)[1] is cache
        assert part.vjp(F, (), g, cache=cache, grad_F=into)[0] is into and torch.equal(into, grad_F)


@pytest.mark.parametrize("name", NAMES)
def test_rows_are_independent(name):
    """A row that is not finite spoils neither its neighbours in a pack nor their gradients, and is not hidden."""
    part, F = part_of(name), states(name)[:32].float()
    g = probe(F)
    value, grad_F = fast(part, F, (), g)
    F[3, 1, 1], F[20, 0, 2] = torch.nan, torch.inf
    spoilt, grad_spoilt = fast(part, F, (), g)
    others = torch.ones(32, dtype=torch.bool)
    others[[3, 20]] = False
    assert torch.equal(spoilt[others], value[others]) and torch.equal(grad_spoilt[others], grad_F[others])
    assert not spoilt[~others].flatten(1).isfinite().all(dim=1).any()


def test_gradients_of_several_laws_in_one_launch_are_those_of_each():
    for names in (list(ELASTIC), list(PLASTIC)):
        laws = [law_of(name, scale) for name in names for scale in (1.0, 1.5)]
        kind = "elasticity" if names[0] in ELASTIC else "plasticity"
        both, F = getattr(side_by_side(laws), kind), deformations(21).repeat(len(laws), 1, 1)
        g = probe(F)
        value, grad_F, grad_rows = fast(both, F, both.weights(), g)
        _, cache = both.evaluate_with_cache(F, both.weights())
        assert torch.equal(both.vjp(F, both.weights(), g, cache)[0], grad_F)
        for law, *own in zip(laws, *(x.chunk(len(laws)) for x in (F, g, value, grad_F)), strict=True):
            part, expected = getattr(law, kind), own[2:]
            for actual, exact in zip(fast(part, own[0], (), own[1]), expected, strict=True):
                assert torch.equal(actual, exact)
        assert grad_rows.shape == (len(laws), 1 + COEFFICIENTS) and not grad_rows[:, 0].any()


@pytest.mark.parametrize("caches", [False, True])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("elastic", "plastic"),
    [
        ("hencky", "von_mises"),
        ("neo_hookean", "von_mises"),
        ("fibre_reinforced", "drucker_prager"),
        ("ogden", "fluid_projection"),
        ("tait", "identity"),
        ("mooney_rivlin", "crushable_foam"),
    ],
)
def test_return_and_stress_at_once_equal_both(elastic, plastic, dtype, caches):
    elastic, plastic, F = part_of(elastic), part_of(plastic), states(plastic)[:55].to(dtype)
    g, g_tau = probe(F), 1e-5 * probe(F.flip(0))
    returned = plastic.evaluate(F, ())
    grad, _ = elastic.vjp(returned, (), g_tau)
    expected = [returned, elastic.evaluate(returned, ()), plastic.vjp(F, (), grad + g)[0]]
    actual = [torch.full_like(F, torch.nan) for _ in range(3)]
    rows = [part.row().to(dtype) for part in (plastic, elastic)]
    cache = kernels.new_cache(F, 1) if caches else None
    inputs = F, *rows, 1, len(F), cache
    launch_blocks(kernels.flow_kernel(dtype), 1, 1, *inputs, *actual[:2])
    launch_blocks(kernels.flow_vjp_kernel(dtype), 1, 1, *inputs, actual[0], g, g_tau, actual[2], None, None)
    for value, exact, tolerance in zip(actual, expected, (8, 512, 512), strict=True):
        assert distance(value, exact) < tolerance * torch.finfo(dtype).eps


class Doubled(AnalyticElasticity):
    """A law of a user."""

    def principal(self, sigma, mu, lam):
        return 2 * mu * sigma.log()


class Derived(Hencky):
    def principal(self, sigma, mu, lam):
        return 2 * super().principal(sigma, mu, lam)


@pytest.mark.parametrize("kind", [Doubled, Derived])
def test_laws_of_users_are_evaluated_by_torch(kind, caplog):
    part = kind(E=E, nu=NU)
    assert not part.native and not part.capturable
    F = deformations(20)
    assert torch.equal(part.evaluate(F, ()), part.response(F, ()))
    rollouts._log_evaluation.cache_clear()
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            rollouts.simulate(
                MPM(16, 1e-3), Law(part, Identity()), moving_cube((0, -1, 0), count=50), [0, 40]
            )
    messages = [record.message for record in caplog.records if "evaluated" in record.message]
    assert messages == [
        f"{kind.__name__} is evaluated by torch, which is slower",
        "Identity is evaluated by native kernels",
    ]


def test_precisions_do_not_mix():
    with pytest.raises(TypeError, match="one dtype"):
        part_of("hencky").evaluate(EYE[None], (), torch.empty(1, 3, 3))


def test_von_mises_yields_by_its_closed_form():
    part, F = part_of("von_mises"), deformations(300, size=0.1)
    _, deviator = hencky_deviator(F)
    yields = deviator.norm(dim=1) > part.row()[1]
    assert torch.equal((part.evaluate(F, ()) != F).any(dim=2).any(dim=1), yields) and 20 < yields.sum() < 280


X86 = pytest.mark.skipif(
    not Path("/proc/cpuinfo").exists() or "avx2" not in Path("/proc/cpuinfo").read_text(), reason="needs AVX2"
)


@X86
@pytest.mark.parametrize("kind", ["elasticity", "plasticity"])
@pytest.mark.parametrize("flags", ["", "-target-cpu haswell"])
def test_processors_with_smaller_registers_agree(flags, kind, monkeypatch):
    """Of 128 and 256 bits, without and with fused multiply-add."""
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", flags)
    kernel = kernels.vjp_kernel.__wrapped__(kind, torch.float32)
    for name in ELASTIC if kind == "elasticity" else PLASTIC:
        part, F = part_of(name), states(name).float()
        g, actual = probe(F), torch.full_like(F, torch.nan)
        launch_blocks(kernel, 1, 1, F, part.row().float(), 1, len(F), None, g, actual, 0)
        assert distance(actual, part.vjp(F, (), g)[0]) < 1e-5


# ----------------------------------------------------------------------------------------------- CUDA


@pytest.fixture(scope="module", params=DTYPES)
def emulated(request, tmp_path_factory):
    if COMPILER is None:
        pytest.skip("needs g++")
    return EmulatedAnalyticLaws(tmp_path_factory.mktemp("emulated"), request.param)


@pytest.mark.parametrize("name", NAMES)
def test_cuda_text_equals_the_cpu_in_emulation(emulated, name):
    """Also the gradient of the coefficients, and with rows that are not a multiple of a block."""
    law = law_of(name)
    both = side_by_side([law, law_of(name, 1.3)])
    part = both.elasticity if name in ELASTIC else both.plasticity
    F = states(name)[:45].repeat(2, 1, 1).to(emulated.dtype)
    weights, g = (part.weights()[0].to(F),), probe(F)
    tolerance = 1e-12 if emulated.dtype == torch.float64 else 1e-5
    for actual, expected in zip(emulated(part, F, weights, g), fast(part, F, weights, g), strict=True):
        assert float((actual - expected).norm()) <= tolerance * float(expected.norm())


CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


@CUDA
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", NAMES)
def test_cuda_equals_the_cpu(name, dtype):
    part, F = part_of(name), states(name).repeat(50, 1, 1).to(dtype)
    g, tolerance = probe(F), 1e-11 if dtype == torch.float64 else 1e-5
    for actual, expected in zip(fast(part, F.cuda(), (), g.cuda()), fast(part, F, (), g), strict=True):
        assert float((actual.cpu() - expected).norm()) <= tolerance * float(expected.norm())


@CUDA
@pytest.mark.parametrize("name", NAMES)
def test_cuda_can_be_captured_and_repeats_itself(name):
    F = states(name).float().repeat(50, 1, 1).cuda()
    assert_can_be_captured(part_of(name), F, (), probe(F))


def test_vanishing_angles_take_no_more_time():
    """Their squares are below the normal numbers, with which processors of x86 compute a hundred times slower."""
    generator, part = torch.Generator().manual_seed(0), part_of("hencky")
    noise = torch.randn(2000, 3, 3, generator=generator)
    out, fastest = torch.empty_like(noise), []
    for F in (torch.eye(3) + 0.1 * noise, torch.eye(3) + 10 ** (-22 + 2 * noise)):
        times = []
        for _ in range(50):
            started = time.process_time()
            part.evaluate(F, (), out)
            times.append(time.process_time() - started)
        fastest.append(min(times))
    assert fastest[1] < 1.5 * fastest[0]
