"""The kernels of the structured laws agree with their torch twin. On a CPU the CUDA source runs in an emulation."""

import pytest
import torch

from neuma_lib.mechanics.plasticity import hencky_strain
from neuma_lib.mechanics.structured_kernels import STRAIN
from tests.support.deformations import rotations
from tests.support.emulated_cuda import COMPILER, EmulatedStructuredLaws
from tests.support.fused_laws import assert_can_be_captured, distance, fast, probe, twin
from tests.support.structured_laws import (
    ELASTIC,
    RETURNS,
    elasticity,
    near_states,
    plasticity,
    random_weights,
)

pytestmark = pytest.mark.core

NAMES = [f"{base} {form}" for base, form in ELASTIC] + list(RETURNS)
DTYPES = torch.float32, torch.float64


def part_of(name):
    return plasticity(name) if name in RETURNS else elasticity(*name.split())


def states(name):
    """(n, 3, 3): deformations, rest, equal and nearly equal stretches, crushed and inverted elements."""
    crushed = [
        [1.2, 0.9, 0.01],
        [1.2, 0.02, 0.01],
        [1.2, 0.02, 0.02],
        [1.2, 0.02, -0.3],
        [0.9, 0.8, -0.7],
        [3, 3, 3],
    ]
    special = torch.diag_embed(torch.tensor(crushed, dtype=torch.float64))
    F = torch.cat([near_states(), rotations(6, 50) @ special @ rotations(6, 51)])
    if name in RETURNS:  # no gradient at the tip of a cone, where rest lies
        trace, _, norm = hencky_strain(torch.linalg.svdvals(F))
        F = F[(trace[:, 0].abs() > 1e-3) & (norm[:, 0] > 1e-3)]
    return F.float().double()


def gain(weights):
    """Largest change of the network's outputs by a change of the strains."""
    return float(torch.stack([torch.linalg.matrix_norm(w.double(), 2) for w in weights]).prod()) / STRAIN


def rounding(part, F, weights, g):
    """Distance of the twin in float32 from float64, of each result: the largest over some frames of reference.

    Singular values of the same states round differently in each of them.
    """
    frames = torch.cat([torch.eye(3, dtype=torch.float64)[None], rotations(5, 60)])
    singles, doubles = tuple(w.float() for w in weights), tuple(w.double() for w in weights)
    actual = []
    for Q in frames:
        turned, probed = (Q @ F.double()).float(), (Q @ g.double()).float()
        exact = twin(part, turned.double(), doubles, probed.double())
        actual.append(
            [distance(*pair) for pair in zip(twin(part, turned, singles, probed), exact, strict=True)]
        )
    return [max(draws) for draws in zip(*actual, strict=True)]


def assert_as_near(part, F, weights, g, actual):
    """Results in float32 are as near to float64 as those of the twin in float32."""
    truth = twin(part, F.double(), tuple(w.double() for w in weights), g.double())
    for value, exact, bound in zip(actual, truth, rounding(part, F, weights, g), strict=True):
        assert distance(value, exact) < 3 * bound + 8 * torch.finfo(torch.float32).eps


@pytest.mark.parametrize("seed", [4, 5])
@pytest.mark.parametrize("name", NAMES)
def test_kernels_equal_their_twin(name, seed):
    part, F = part_of(name), states(name)
    weights, g = random_weights(part, seed), probe(F)
    # rounding of the strains, grown by the network; rows are compared with their own size
    bound = 8 * torch.finfo(torch.float64).eps * gain(weights)
    for value, expected in zip(fast(part, F, weights, g), twin(part, F, weights, g), strict=True):
        assert float((value - expected).norm()) < bound * float(expected.norm())
    F, g = F.float(), g.float()
    weights = tuple(w.float() for w in weights)
    assert_as_near(part, F, weights, g, fast(part, F, weights, g))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["hencky stretch", "neo_hookean energy", "cohesive"])
def test_cache_buffers_and_accumulators(name, dtype):
    part = part_of(name)
    weights = random_weights(part, 1, dtype)
    for count in (1, 8, 13, 0):
        F = states(name)[:count].to(dtype)
        g = probe(F)
        expected, grad_F, *grads = fast(part, F, weights, g)
        out = torch.full((count, 6, 3), torch.nan, dtype=dtype)[:, ::2]  # no contiguous memory
        value, cache = part.evaluate_with_cache(F, weights, out)
        assert value is out and torch.equal(out, expected)
        assert part.evaluate_with_cache(F, weights, cache=cache)[1] is cache
        totals = tuple(torch.ones(*reversed(w.shape), dtype=dtype).mT for w in weights)
        into = torch.full_like(F, torch.nan)
        returned = part.vjp(F, weights, g, cache=cache, grad_F=into, grad_weights=totals)
        assert returned[0] is into and returned[1] is totals and torch.equal(into, grad_F)
        for total, grad in zip(totals, grads, strict=True):
            torch.testing.assert_close(
                total - 1, grad, rtol=0, atol=4 * torch.finfo(dtype).eps * float(1 + grad.norm())
            )


def test_rows_are_independent():
    """A row that is not finite spoils neither its neighbours in a pack nor their gradients."""
    part = part_of("hencky stretch")
    F = states("hencky stretch")[:16].float()
    weights, g = random_weights(part, 1, torch.float32), probe(F)
    value, grad_F, *_ = fast(part, F, weights, g)
    F[3, 1, 1] = torch.nan
    spoilt, grad_spoilt, *_ = fast(part, F, weights, g)
    others = torch.arange(16) != 3
    assert not spoilt[3].isfinite().any() and not grad_spoilt[3].isfinite().any()
    assert torch.equal(spoilt[others], value[others]) and torch.equal(grad_spoilt[others], grad_F[others])


def test_precisions_do_not_mix():
    part, F = part_of("hencky stretch"), states("hencky stretch")
    with pytest.raises(TypeError, match="one dtype"):
        part.evaluate(F, random_weights(part, 1, torch.float32))


# ----------------------------------------------------------------------------------------------- CUDA


@pytest.fixture(scope="module", params=DTYPES)
def emulated(request, tmp_path_factory):
    if COMPILER is None:
        pytest.skip("needs g++")
    return EmulatedStructuredLaws(tmp_path_factory.mktemp("emulated"), request.param)


@pytest.mark.parametrize("name", NAMES)
def test_cuda_text_equals_the_twin_in_emulation(emulated, name):
    part, F = part_of(name), states(name)
    F = torch.cat([F, F])[: 67 + len(F)]  # one tile and a part of another
    weights = tuple(w.float().double() for w in random_weights(part, 4))
    g = probe(F)
    for blocks in (1, 2):
        actual = emulated(part, F, weights, g, blocks)
        if emulated.dtype == torch.float32:
            assert_as_near(part, F, weights, g, actual)
            continue
        bound = 8 * torch.finfo(torch.float64).eps * gain(weights)
        for value, expected in zip(actual, twin(part, F, weights, g), strict=True):
            assert float((value - expected).norm()) < bound * float(expected.norm())


CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


@CUDA
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("repeats", [1, 400])
def test_cuda_equals_the_cpu(name, dtype, repeats):
    part, F = part_of(name), states(name).repeat(repeats, 1, 1).to(dtype)
    weights, g = random_weights(part, 4, dtype), probe(F)
    actual = fast(part, F.cuda(), tuple(w.cuda() for w in weights), g.cuda())
    actual = [x.cpu() for x in actual]
    if dtype == torch.float32:
        assert_as_near(part, F, weights, g, actual)
        return
    bound = 8 * torch.finfo(torch.float64).eps * gain(weights)
    for value, expected in zip(actual, fast(part, F, weights, g), strict=True):
        assert float((value - expected).norm()) < bound * float(expected.norm())


@CUDA
@pytest.mark.parametrize("name", NAMES)
def test_cuda_can_be_captured_and_repeats_itself(name):
    part = part_of(name)
    F = states(name).float().repeat(70, 1, 1).cuda()
    weights, g = tuple(w.cuda() for w in random_weights(part, 4, torch.float32)), probe(F)
    assert_can_be_captured(part, F, weights, g)
