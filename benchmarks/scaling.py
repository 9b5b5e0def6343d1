"""How time and memory of a training iteration grow with every size of the problem.

    python -m benchmarks.scaling --output docs/results          # minutes on a GPU
    python -m benchmarks.scaling --small                        # the same around the default scale, for a CPU

One size at a time is varied, the others stay at the paper's scale (or, with --small, at the default scale). Particles,
grid and steps are measured on simulation and networks alone, frames and resolution on whole iterations. Writes
scaling.csv and scaling.png, and prints the exponent p of time ~ size^p between the two largest sizes.
"""

import dataclasses
import gc
import math
from pathlib import Path

import torch

from benchmarks.iteration import iterations, simulate_and_back
from benchmarks.scene import SMALL, Size, make_scene
from benchmarks.timing import device_name, parser_of, peak_memory, seconds
from neuma_lib.evaluation.text_tables import as_csv
from neuma_lib.io.files import write_text
from neuma_lib.sim.workspace import free_pool

SWEEPS = {
    "particles": (5_000, 10_000, 30_000, 60_000, 120_000, 240_000),
    "grid": (24, 32, 48, 64, 96, 128),
    "steps": (100, 200, 400, 800, 1600),
    "frames": (50, 100, 200, 400),
    "pixels": (200, 400, 800, 1200),
}
SMALL_SWEEPS = {
    "particles": (500, 1000, 2000, 4000, 8000, 16000, 32000),
    "grid": (16, 24, 32, 48),
    "steps": (50, 100, 200),
    "frames": (5, 10, 20),
    "pixels": (48, 96, 192),
}
UNITS = {
    "particles": "particles",
    "grid": "grid nodes along an edge",
    "steps": "steps",
    "frames": "frames rendered",
    "pixels": "image edge [px]",
}
COST = {"grid": 3.0, "pixels": 2.0}
"""Power of a size that the amount of work grows with, where it is not 1."""


def measure(
    axis: str, value: int, base: Size, device: torch.device, memory: float | None
) -> tuple[float, float]:
    """Seconds and peak bytes of an iteration, or of its simulation for sizes that rendering does not see."""
    size = dataclasses.replace(base, **{axis: value})
    rendered = axis in ("frames", "pixels")
    if axis == "grid":  # the same Courant number
        size = dataclasses.replace(size, dt=base.dt * min(1.0, base.grid / value))
    if axis == "steps":
        size = dataclasses.replace(size, frames=min(base.frames, value))
    scene = make_scene(size if rendered else dataclasses.replace(size, gaussians=10, pixels=8), device)
    times = []

    def work():
        if rendered:
            times.extend(iterations(scene, 5)[3:])
        else:
            times.append(seconds(lambda: simulate_and_back(scene, memory=memory), device, 3))

    peak = peak_memory(work, device)
    return min(times), peak


def free_memory(device: torch.device) -> None:
    """Free all memory, so that it does not affect the next size."""
    free_pool()
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def exponent(axis: str, rows: list[dict]) -> float:
    """Exponent of the time in the amount of work between the two largest sizes: 1 is linear."""
    a, b = rows[-2:]
    return math.log(b["seconds"] / a["seconds"]) / (COST.get(axis, 1.0) * math.log(b["size"] / a["size"]))


def draw(rows: list[dict], path: Path, title: str) -> None:
    """Time and memory over every size, with a line of slope one."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FuncFormatter, LogLocator

    axes_names = list(dict.fromkeys(row["axis"] for row in rows))
    figure, axes = plt.subplots(2, len(axes_names), figsize=(2.3 * len(axes_names), 4.2), squeeze=False)
    for column, axis in enumerate(axes_names):
        mine = [row for row in rows if row["axis"] == axis]
        sizes = [row["size"] for row in mine]
        for ax, key, factor, unit in zip(
            axes[:, column], ("seconds", "bytes"), (1e3, 2.0**-30), ("time [ms]", "memory [GiB]"), strict=True
        ):
            values = [factor * row[key] for row in mine]
            ax.loglog(sizes, values, "o-", color="#0072B2", markersize=4)
            power = COST.get(axis, 1.0)
            ax.loglog(
                sizes,
                [values[-1] * (s / sizes[-1]) ** power for s in sizes],
                ":",
                color="#7f7f7f",
                linewidth=1,
            )
            ax.set_xticks(sizes, [f"{s:,}" for s in sizes], rotation=45, fontsize=7)
            ax.minorticks_off()
            ax.set_ylim(0.5 * min(values), 2 * max(values))
            ax.yaxis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5)))
            ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            ax.tick_params(labelsize=7)
            if column == 0:
                ax.set_ylabel(unit, fontsize=8)
        axes[1, column].set_xlabel(UNITS[axis], fontsize=8)
    figure.suptitle(f"{title}; dotted: proportional to the work", fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=160)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--small", action="store_true", help="around the default scale, for a CPU")
    parser.add_argument("--axes", nargs="+", choices=list(SWEEPS), default=list(SWEEPS))
    parser.add_argument("--memory", type=float, help="most GiB for the gradient's states; default: no limit")
    parser.add_argument("--output", type=Path, default=Path("."))
    args = parser.parse_args()
    torch.set_num_threads(1)
    device = torch.device(args.device)
    base, sweeps = (SMALL, SMALL_SWEEPS) if args.small or device.type == "cpu" else (Size(), SWEEPS)
    memory = None if args.memory is None else args.memory * 2**30
    rows = []
    print("| varied | size | time [ms] | peak memory [GiB] |\n|---|---:|---:|---:|")
    for axis in args.axes:
        for value in sweeps[axis]:
            time, peak = measure(axis, value, base, device, memory)
            free_memory(device)
            rows.append({"axis": axis, "size": value, "seconds": time, "bytes": peak})
            print(f"| {UNITS[axis]} | {value} | {1e3 * time:.1f} | {peak / 2**30:.2f} |", flush=True)
    write_text(args.output / "scaling.csv", as_csv([rows[0], *(row.values() for row in rows)]))
    title = f"{device_name(device)}; others: {base.particles} particles, {base.grid}³, {base.steps} steps"
    draw(rows, args.output / "scaling.png", title)
    for axis in args.axes:
        mine = [row for row in rows if row["axis"] == axis]
        print(f"{axis}: time grows as work^{exponent(axis, mine):.2f} between the two largest sizes")


if __name__ == "__main__":
    main()
