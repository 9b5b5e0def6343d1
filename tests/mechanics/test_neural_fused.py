"""The fused kernels of the neural law agree with their twin. On a CPU the same source runs in an emulation."""

import pytest
import torch

from neuma_lib.mechanics import neural_fused as fused
from neuma_lib.mechanics.neural import neural_law
from tests.support import fused_laws
from tests.support.emulated_cuda import COMPILER, EmulatedLaws
from tests.support.fused_laws import assert_can_be_captured, distance, probe

pytestmark = pytest.mark.core

KINDS = ("elasticity", "plasticity")
REGIMES = ("near identity", "large strain", "inverted")


def deformations(regime, n, seed=0):
    """(n, 3, 3) float64, rounded to float32."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(n, 3, 3, generator=generator, dtype=torch.float64)
    F = torch.eye(3, dtype=torch.float64) + (0.4 if regime == "large strain" else 1e-2) * noise
    if regime == "inverted":
        F = torch.linalg.qr(noise)[0] @ torch.diag(torch.tensor([1.3, 0.8, -0.6], dtype=torch.float64)) @ F
    return F.float().double()


def law_part(kind):
    """A law whose weights differ in size by layer, as trained ones do."""
    part = getattr(neural_law(seed=3), kind).double()
    for weight, size in zip(part.base, (0.7, 1.3, 400.0), strict=True):
        weight.mul_(size)
        weight.copy_(weight.float())
    return part


def twin(part, F, g, dtype):
    """Result, gradient of F and gradients of the weights by the twin, in float64."""
    weights = tuple(w.to(F.device, dtype) for w in part.weights())
    return [x.double() for x in fused_laws.twin(part, F.to(dtype), weights, g.to(dtype))]


@pytest.fixture(scope="module")
def emulated(tmp_path_factory):
    if COMPILER is None:
        pytest.skip("needs g++")
    return EmulatedLaws(tmp_path_factory.mktemp("emulated"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "regime, n, blocks", [(REGIMES[0], 1, 1), (REGIMES[1], 133, 1), (REGIMES[2], 133, 2)]
)
def test_emulated_kernels_are_as_near_to_float64_as_the_float32_twin(emulated, kind, regime, n, blocks):
    part, F = law_part(kind), deformations(regime, n)
    g = probe(F)
    truth, plain = twin(part, F, g, torch.float64), twin(part, F, g, torch.float32)
    actual = emulated(part, F, g, blocks)
    for exact, slow, fast in zip(truth, plain, actual, strict=True):
        assert distance(fast, exact) < 5 * distance(slow, exact) + 1e-7


def test_emulated_gradients_of_many_calls_add_up(emulated):
    part, F = law_part("elasticity"), deformations("large strain", 133)
    g = probe(F)
    once, twice = emulated(part, F, g, 1), emulated(part, F, g, 1, additions=2)
    assert torch.equal(once[1], twice[1])
    for single, double in zip(once[2:], twice[2:], strict=True):
        assert distance(double, 2 * single) < 1e-6


HALF_ERROR = 3e-3
"""Of the adjoint in half precision, by norm: factors of 11 bits are off by 5e-4 at most, a few products in a row."""


def check_half(half, single):
    """(gradient of F, gradients of the weights) at g and at multiples of g."""
    for size in (1.0, 1e-12, 1e6):
        for rough, fine in zip(half(size), single(size), strict=True):
            assert rough.isfinite().all() and 0 < distance(rough, fine) < HALF_ERROR
    assert all(torch.equal(x, torch.zeros_like(x)) for x in half(0.0))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("regime", REGIMES)
def test_emulated_half_adjoint_is_near_the_single_one(emulated, kind, regime):
    part, F = law_part(kind), deformations(regime, 133)
    g = probe(F)

    def gradients(precision):
        return lambda size: emulated(part, F, size * g, 2, precision)[1:]

    check_half(gradients("half"), gradients("single"))


def test_small_gradients_next_to_large_ones_survive_half_precision(emulated):
    part, F = law_part("elasticity"), deformations("large strain", 64)
    g = probe(F)
    g[:16] *= 1e-6
    rough, fine = (emulated(part, F, g, 1, precision)[1][:16] for precision in ("half", "single"))
    assert distance(rough, fine) < 3 * HALF_ERROR


def test_float64_on_a_gpu_uses_the_twin():
    assert not fused.supported(torch.device("cuda"), torch.float64)


CUDA = pytest.mark.skipif(
    not (torch.cuda.is_available() and fused.supported(torch.device("cuda", 0), torch.float32)),
    reason="needs a CUDA GPU with float16 tensor cores and 113 KB of shared memory a block",
)


def on_gpu(part, F, g):
    """Arguments of the fused kernels: float32 on the GPU, rows that begin between multiples of 16 bytes."""
    F, g = (torch.cat([x[:1], x]).float().cuda()[1:] for x in (F, g))
    return F, tuple(w.float().cuda() for w in part.weights()), g


@CUDA
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("n", [1, 31, 4096 + 5, 30_000, 70_001])
def test_fused_is_as_near_to_float64_as_the_float32_twin(kind, regime, n):
    part, F = law_part(kind), deformations(regime, n)
    g = probe(F)
    F32, weights, g32 = on_gpu(part, F, g)
    actual = [x.double() for x in fused_laws.fast(part, F32, weights, g32)]
    truth, plain = (twin(part, F.cuda(), g.cuda(), dtype) for dtype in (torch.float64, torch.float32))
    for exact, slow, fast in zip(truth, plain, actual, strict=True):
        assert distance(fast, exact) < 5 * distance(slow, exact) + 1e-7


@CUDA
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("n", [31, 30_000])
def test_half_adjoint_is_near_the_single_one(kind, regime, n):
    part, F = law_part(kind), deformations(regime, n)
    g = probe(F)
    F, weights, g = on_gpu(part, F, g)
    before = part.evaluate(F, weights)

    def gradients(precision):
        def at(size):
            part.adjoint_precision = precision
            grad_F, grad_weights = part.vjp(F, weights, size * g)
            return [x.double() for x in (grad_F, *grad_weights)]

        return at

    check_half(gradients("half"), gradients("single"))
    part.adjoint_precision = "half"
    assert torch.equal(part.evaluate(F, weights), before)


@CUDA
@pytest.mark.parametrize("kind", KINDS)
def test_fused_fills_buffers_accumulates_and_repeats_itself(kind):
    part = law_part(kind)
    F, weights, g = on_gpu(part, F := deformations("large strain", 1000), probe(F))
    out, grad_F = torch.empty_like(F), torch.empty_like(F)
    totals = tuple(torch.ones_like(w) for w in weights)
    assert part.evaluate_with_cache(F, weights, out) == (out, None)
    plain_F, plain_weights = part.vjp(F, weights, g)
    returned = part.vjp(F, weights, g, grad_F=grad_F, grad_weights=totals)
    assert returned[0] is grad_F and returned[1] is totals
    assert torch.equal(out, part.evaluate(F, weights)) and torch.equal(grad_F, plain_F)
    for total, grad in zip(totals, plain_weights, strict=True):
        assert torch.equal(total, grad + 1)
    sums = part.accumulators(F, totals)
    for _ in range(2):
        part.vjp(F, weights, g, grad_weights=sums)
    added = tuple(torch.ones_like(w) for w in weights)
    part.add_up(sums, weights, added)
    for total, grad in zip(added, plain_weights, strict=True):
        assert distance(total - 1, 2 * grad) < 1e-5
    strided = tuple(torch.zeros(*reversed(w.shape), device="cuda").mT for w in weights)
    part.vjp(F, weights, g, grad_weights=strided)
    assert all(torch.equal(a, b) for a, b in zip(strided, plain_weights, strict=True))


@CUDA
def test_non_finite_rows_stay_non_finite():
    part = law_part("elasticity")
    F, weights, g = on_gpu(part, F := deformations("near identity", 300), probe(F))
    F[200, 1, 1] = float("nan")
    value = part.evaluate(F, weights)
    grad_F, _ = part.vjp(F, weights, g)
    assert value[200].isnan().all() and grad_F[200].isnan().any()
    assert value[:128].isfinite().all() and grad_F[:128].isfinite().all()


@CUDA
@pytest.mark.parametrize("kind", KINDS)
def test_fused_can_be_captured_in_a_graph(kind):
    part, F = law_part(kind), deformations("large strain", 5000)
    F, weights, g = on_gpu(part, F, probe(F))
    assert_can_be_captured(part, F, weights, g)
