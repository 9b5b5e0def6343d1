"""Checks that the tests of fused kernels of laws share."""

import torch

from neuma_lib.mechanics.law import Constitutive


def twin(part, F, weights, g):
    """Result, gradient of F and of the weights by torch."""
    grad_F, grads = Constitutive.vjp(part, F, weights, g)
    return [Constitutive.evaluate(part, F, weights), grad_F, *grads]


def fast(part, F, weights, g):
    """The same by the kernels."""
    grad_F, grads = part.vjp(F, weights, g)
    return [part.evaluate(F, weights), grad_F, *grads]


def distance(a: torch.Tensor, b: torch.Tensor) -> float:
    """Relative distance of a from b, by norm."""
    return float((a.double() - b.double()).norm() / b.double().norm())


def probe(F: torch.Tensor) -> torch.Tensor:
    """A random gradient of a law's result, rounded to float32."""
    g = torch.randn(F.shape, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    return g.float().to(F)


def assert_can_be_captured(part, F: torch.Tensor, weights, g: torch.Tensor) -> None:
    """A recorded evaluation and its adjoint on a GPU give the same bytes when they are replayed."""
    out, grad_F = torch.empty_like(F), torch.empty_like(F)
    totals = tuple(torch.zeros_like(w) for w in weights)

    def work():
        _, cache = part.evaluate_with_cache(F, weights, out)
        assert cache is None
        part.vjp(F, weights, g, cache=cache, grad_F=grad_F, grad_weights=totals)

    work()
    expected = [out.clone(), grad_F.clone(), *(2 * t for t in totals)]
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        work()
    for buffer in (out, grad_F):
        buffer.zero_()
    graph.replay()
    for replayed, value in zip((out, grad_F, *totals), expected, strict=True):
        assert torch.equal(replayed, value)
