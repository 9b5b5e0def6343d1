"""The vector kernels of the neural law on a CPU agree with their twin."""

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
import warp as wp

from neuma_lib.mechanics import neural_vector as vector
from neuma_lib.mechanics.fused_launch import launch_blocks
from neuma_lib.mechanics.neural import neural_law
from tests.mechanics.test_neural_fused import KINDS, REGIMES, deformations, law_part, twin
from tests.support.deformations import assert_adjoint
from tests.support.fused_laws import distance, probe

pytestmark = pytest.mark.core

DTYPES = (torch.float32, torch.float64)
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-11}


def fast(part, F, g, cached=False):
    """Result, gradient of F and gradients of the weights by the vector kernels, in the dtype of F."""
    weights, cache = tuple(w.to(F.dtype) for w in part.weights()), None
    if cached:
        value, cache = part.evaluate_with_cache(F, weights)
    else:
        value = part.evaluate(F, weights)
    grad_F, grad_weights = part.vjp(F, weights, g, cache=cache)
    return [value, grad_F, *grad_weights]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("n", [1, 64, 133, 1029])
def test_equals_the_twin(kind, regime, n, dtype):
    part, F = law_part(kind), deformations(regime, n)
    g = probe(F)
    expected = twin(part, F, g, dtype)
    actual = fast(part, F.to(dtype), g.to(dtype))
    assert all(distance(a, b) < TOLERANCE[dtype] for a, b in zip(actual, expected, strict=True))
    cached = fast(part, F.to(dtype), g.to(dtype), cached=True)
    assert all(torch.equal(a, b) for a, b in zip(actual, cached, strict=True))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("regime", REGIMES)
def test_is_as_near_to_float64_as_the_float32_twin(kind, regime):
    part, F = law_part(kind), deformations(regime, 133)
    g = probe(F)
    truth, plain = twin(part, F, g, torch.float64), twin(part, F, g, torch.float32)
    for exact, slow, actual in zip(truth, plain, fast(part, F.float(), g.float()), strict=True):
        assert distance(actual, exact) < 1.5 * distance(slow, exact) + 1e-7


@pytest.mark.parametrize("kind", KINDS)
def test_adjoint_against_differences(kind):
    part = law_part(kind)
    assert_adjoint(part, deformations("large strain", 70))


@pytest.mark.parametrize("dtype", DTYPES)
def test_gelu_is_accurate_to_round_off(dtype):
    """The same polynomials as in the kernel, in torch, beyond the range too."""
    distribution, density = vector.gelu_polynomials(dtype)
    x = torch.linspace(-12, 12, 100_001, dtype=torch.float64).to(dtype)
    bound = vector.RANGE[dtype]
    a = x.clamp(-bound, bound)

    def polynomial(coefficients, t):
        value = torch.zeros_like(t)
        for c in coefficients:
            value = value * t + c
        return value

    phi = a * polynomial(distribution, a * a * (2 / bound**2) - 1) + 0.5
    exponent = -0.5 / math.log(2) * a * a
    slope = phi + a * polynomial(density, exponent - exponent.round()) * torch.exp2(exponent.round())
    y = x.double()
    exact = 0.5 * torch.erfc(-y / 2**0.5)
    exact_slope = exact + y * torch.exp(-0.5 * y * y) / (2 * math.pi) ** 0.5
    round_off = 4 * torch.finfo(dtype).eps if dtype == torch.float32 else 1e-13
    assert float((phi - exact).abs().max()) < round_off
    assert float((slope - exact_slope).abs().max()) < round_off


@pytest.mark.parametrize("kind", KINDS)
def test_large_features_saturate_as_in_the_twin(kind):
    """Stretches of 30, whose activations are far beyond the range of the polynomials."""
    part, F = law_part(kind), 30 * deformations("large strain", 100)
    g = probe(F)
    expected = twin(part, F, g, torch.float32)
    actual = fast(part, F.float(), g.float())
    assert all(distance(a, b) < 1e-5 for a, b in zip(actual, expected, strict=True))


@pytest.mark.parametrize("kind", KINDS)
def test_rows_do_not_depend_on_their_place(kind):
    part, F = law_part(kind), deformations("large strain", 201).float()
    g, order = probe(F), torch.randperm(201, generator=torch.Generator().manual_seed(2))
    value, grad_F, *grad_weights = fast(part, F, g)
    moved, moved_F, *moved_weights = fast(part, F[order], g[order])
    assert torch.equal(moved, value[order]) and torch.equal(moved_F, grad_F[order])
    again = fast(part, F, g)
    for once, twice in zip((value, grad_F, *grad_weights), again, strict=True):
        assert torch.equal(once, twice)
    for a, b in zip(grad_weights, moved_weights, strict=True):
        assert distance(a, b) < 1e-5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_non_finite_rows_stay_non_finite_and_alone(kind, bad):
    part, F = law_part(kind), deformations("near identity", 150).float()
    g = probe(F)
    before = fast(part, F, g)
    F[100, 1, 1] = bad
    value, grad_F, *grad_weights = fast(part, F, g)
    assert value[100].isnan().any() and grad_F[100].isnan().any()
    others = torch.arange(150) != 100
    assert torch.equal(value[others], before[0][others]) and torch.equal(grad_F[others], before[1][others])
    assert all(grad.isnan().any() for grad in grad_weights)


def test_no_row_is_no_work():
    part = law_part("elasticity")
    value, grad_F, *grad_weights = fast(part, torch.zeros(0, 3, 3), torch.zeros(0, 3, 3))
    assert len(value) == len(grad_F) == 0 and not any(grad.any() for grad in grad_weights)


@pytest.mark.parametrize("dtype", DTYPES)
def test_strided_and_unaligned_memory(dtype):
    part, F = law_part("elasticity"), deformations("large strain", 90).to(dtype)
    g = probe(F)
    value, grad_F, *grad_weights = fast(part, F, g)
    weights = tuple(
        torch.cat([torch.zeros(1, dtype=dtype), w.to(dtype).flatten()])[1:].view_as(w) for w in part.weights()
    )
    shifted = torch.cat([F[:1], F])[1:]
    out = torch.empty(3, 3, 90, dtype=dtype).permute(2, 0, 1)
    assert part.evaluate(shifted, weights, out) is out and torch.equal(out, value)
    totals = tuple(torch.ones(*reversed(w.shape), dtype=dtype).mT for w in weights)
    received = torch.empty_like(out)
    part.vjp(shifted, weights, g, grad_F=received, grad_weights=totals)
    assert torch.equal(received, grad_F)
    for total, grad in zip(totals, grad_weights, strict=True):
        torch.testing.assert_close(total, grad + 1)


def test_threads_do_not_share_scratch_memory():
    part, F = law_part("elasticity"), deformations("large strain", 500).float()
    batches = [F * (1 + 0.01 * i) for i in range(8)]
    g = probe(F)
    alone = [fast(part, batch, g) for batch in batches]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda batch: fast(part, batch, g), 4 * batches))
    for one, other in zip(4 * alone, together, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


X86 = pytest.mark.skipif(
    not Path("/proc/cpuinfo").exists() or "avx2" not in Path("/proc/cpuinfo").read_text(), reason="needs AVX2"
)


@X86
@pytest.mark.parametrize("flags", ["", "-target-cpu haswell"])
def test_processors_with_smaller_registers_agree(flags, monkeypatch):
    """Of 128 and 256 bits, without and with fused multiply-add."""
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", flags)
    part, F = law_part("elasticity"), deformations("large strain", 133).float()
    g, weights = probe(F), tuple(w.float() for w in part.weights())
    expected = fast(part, F, g)
    actual = [torch.empty_like(F), torch.empty_like(F), *(torch.zeros_like(w) for w in weights)]
    common = F, *weights, 1, part.scale, len(F), 0, None
    evaluate = vector.evaluate_kernel.__wrapped__(torch.float32)
    vjp = vector.vjp_kernel.__wrapped__(torch.float32)
    launch_blocks(evaluate, 1, 1, *common, actual[0])
    launch_blocks(vjp, 1, 1, *common, 0, g, *actual[1:])
    assert all(distance(a, b) < 1e-5 for a, b in zip(actual, expected, strict=True))


def test_a_law_at_rest_has_no_stress():
    law, rest = neural_law(seed=1), torch.eye(3).repeat(3, 1, 1)
    part = law.elasticity
    assert float(part.evaluate(rest, tuple(w.detach() for w in part.weights())).abs().max()) < 1e-5
