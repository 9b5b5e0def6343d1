"""Time of one call of a neural law's networks, fused and by their twin, against what the hardware allows.

    python -m benchmarks.laws                              # 2,000 rows on the CPU
    python -m benchmarks.laws --rows 30000 --device cuda

On a GPU the calls are recorded in a CUDA graph, so that the time is the kernels' own. The floors are those of an
NVIDIA H200: F and the result once through memory at 4.3 TB/s; the products of the networks at 67 TFLOP/s, its peak
in float32, and three times as many at 989 TFLOP/s, its peak in float16.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch

from neuma_lib.mechanics.neural import SHAPES, NeuralConstitutive, neural_law

BANDWIDTH = 4.3e12
"""Bytes per second of a copy."""
FLOAT32, FLOAT16 = 67e12, 989e12
"""Operations per second."""
CALLS = 50


def floors(rows: int, backward: bool) -> tuple[float, float, float]:
    """Seconds for the memory traffic, for the products in float32, and for their split into halves.

    Backward counts the recomputation of the forward pass, which the fused kernel cannot avoid.
    """
    operations = 2 * rows * sum(a * b for a, b in SHAPES) * (3 if backward else 1)
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


def calls(part: NeuralConstitutive, F: torch.Tensor, g: torch.Tensor) -> dict[str, Callable[[], object]]:
    """The passes of one network at F (n, 3, 3) with gradient g (n, 3, 3), into buffers of their own."""
    weights = tuple(w.detach() for w in part.weights())
    totals = tuple(torch.zeros_like(w) for w in weights)
    out, grad_F = torch.empty_like(F), torch.empty_like(F)
    return {
        "forward": lambda: part.evaluate(F, weights, out),
        "backward": lambda: part.vjp(F, weights, g, grad_F=grad_F, grad_weights=totals),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, nargs="+", default=[2000])
    parser.add_argument("--repetitions", type=int, default=10)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()

    device = torch.device(args.device)
    law = neural_law(seed=0).to(device)
    print(
        f"{'rows':>8} {'network':12} {'pass':9} {'path':6} {'us':>9} {'bytes':>7} {'fp32':>7} {'3 fp16':>7}"
    )
    for rows in args.rows:
        generator = torch.Generator().manual_seed(0)
        F = (torch.eye(3) + 0.1 * torch.randn(rows, 3, 3, generator=generator)).to(device)
        g = torch.randn(rows, 3, 3, generator=generator).to(device)
        for name, part in law.parts.items():
            for path in ("fused", "twin") if part.uses_fused(F) else ("twin",):
                part.fused = path == "fused"
                for which, call in calls(part, F, g).items():
                    seconds = seconds_per_call(call, device, args.repetitions)
                    limits = " ".join(f"{1e6 * x:7.2f}" for x in floors(rows, which == "backward"))
                    print(f"{rows:8d} {name:12} {which:9} {path:6} {1e6 * seconds:9.1f} {limits}", flush=True)
            part.fused = None


if __name__ == "__main__":
    main()
