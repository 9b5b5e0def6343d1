"""Time of one call of a law's networks, fused and by their twin, against what the hardware allows.

    python -m benchmarks.laws                              # 2,000 rows on the CPU
    python -m benchmarks.laws --rows 30000 --device cuda
    python -m benchmarks.laws --rows 30000 --device cuda --adjoint-precision half

On a GPU the calls are recorded in a CUDA graph, so that the time is the kernels' own. The floors are those of an
NVIDIA H200: F and the result once through memory at 4.3 TB/s; the products of the networks at 67 TFLOP/s, its peak
in float32, and three times as many at 989 TFLOP/s, its peak in float16.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch

from neuma_lib.mechanics.adaptor import AdaptableConstitutive
from neuma_lib.mechanics.law import Constitutive
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import FORMS, structured_law

BANDWIDTH = 4.3e12
"""Bytes per second of a copy."""
FLOAT32, FLOAT16 = 67e12, 989e12
"""Operations per second."""
CALLS = 50
SOFT = {
    "elasticity": {"name": "hencky", "E": 1e5, "nu": 0.3},
    "plasticity": {"name": "von_mises", "yield_stress": 5e3},
}


def floors(rows: int, weights: int, backward: bool) -> tuple[float, float, float]:
    """Seconds for the memory traffic, for the networks' products in float32, and for their split into halves.

    Backward counts the recomputation of the forward pass, which the fused kernel cannot avoid.
    """
    operations = 2 * rows * weights * (3 if backward else 1)
    matrices = 3 if backward else 2
    return 36 * rows * matrices / BANDWIDTH, operations / FLOAT32, 3 * operations / FLOAT16


def seconds_per_call(call: Callable[[], object], device: torch.device, repetitions: int) -> float:
    """The fastest of several measurements: other load only adds time."""
    call()
    if device.type == "cpu":
        return min(_wall_time(call) for _ in range(repetitions))
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        call()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        for _ in range(CALLS):
            call()
    times = []
    for _ in range(repetitions + 1):
        start, stop = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        graph.replay()
        stop.record()
        stop.synchronize()
        times.append(start.elapsed_time(stop) * 1e-3 / CALLS)
    return min(times[1:])


def _wall_time(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def calls(
    part: AdaptableConstitutive, F: torch.Tensor, g: torch.Tensor, plain: bool = False
) -> dict[str, Callable[[], object]]:
    """The passes of one network at F (n, 3, 3) with gradient g (n, 3, 3), into buffers of their own, or in torch."""
    weights = tuple(w.detach() for w in part.weights())
    totals = tuple(torch.zeros_like(w) for w in weights)
    out, grad_F = torch.empty_like(F), torch.empty_like(F)
    if plain:
        return {
            "forward": lambda: Constitutive.evaluate(part, F, weights, out),
            "backward": lambda: Constitutive.vjp(part, F, weights, g, None, grad_F, totals),
        }
    passes = {
        "forward": lambda: part.evaluate(F, weights, out),
        "backward": lambda: part.vjp(F, weights, g, grad_F=grad_F, grad_weights=totals),
    }
    _, cache = part.evaluate_with_cache(F, weights, out)
    if cache is not None:
        passes["cached"] = lambda: part.evaluate_with_cache(F, weights, out, cache)
        passes["from it"] = lambda: part.vjp(F, weights, g, cache, grad_F, totals)
    return passes


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, nargs="+", default=[2000])
    parser.add_argument("--repetitions", type=int, default=10)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--adjoint-precision", default="single", choices=("single", "half"))
    args = parser.parse_args()

    device = torch.device(args.device)
    neural = neural_law(seed=0).to(device)
    neural.set_adjoint_precision(args.adjoint_precision)
    structured = {form: structured_law({**SOFT, "form": form}).to(device) for form in FORMS}
    networks = {f"{form} elasticity": law.elasticity for form, law in structured.items()}
    networks["return map"] = structured["stretch"].plasticity
    fused = neural.elasticity.uses_fused(torch.zeros(1, 3, 3, device=device))
    parts = [
        (f"neural {name}", part, path)
        for name, part in neural.parts.items()
        for path in (("fused", "twin") if fused else ("twin",))
    ]
    parts += [(name, part, path) for name, part in networks.items() for path in ("fused", "torch")]
    print(
        f"{'rows':>8} {'network':20} {'pass':9} {'path':6} {'us':>9} {'bytes':>7} {'fp32':>7} {'3 fp16':>7}"
    )
    for rows in args.rows:
        generator = torch.Generator().manual_seed(0)
        F = (torch.eye(3) + 0.1 * torch.randn(rows, 3, 3, generator=generator)).to(device)
        g = torch.randn(rows, 3, 3, generator=generator).to(device)
        for name, part, path in parts:
            if name.startswith("neural"):
                part.fused = path == "fused"
            # autograd of the plain twins of structured laws cannot be recorded in a graph
            plain = path == "torch"
            if plain and device.type == "cuda":
                continue
            for which, call in calls(part, F, g, plain).items():
                seconds = seconds_per_call(call, device, args.repetitions)
                weights = sum(w.numel() for w in part.base)
                limits = " ".join(
                    f"{1e6 * x:7.2f}" for x in floors(rows, weights, which in ("backward", "from it"))
                )
                print(f"{rows:8d} {name:20} {which:9} {path:6} {1e6 * seconds:9.1f} {limits}", flush=True)


if __name__ == "__main__":
    main()
