"""Error of the true law against converged truths, and core seconds, over grid, particles and time step.

python -m benchmarks.default_grid BouncyBall_converged ... [--grids 24 36 48] [--particles 1000 2000 4000] [--out FILE]

Reads truth.h5 of scenes with `truth: converged`. The time step is that of the scene on its grid, divided by the factors
`--substeps` and rounded down to keep the Courant number on finer grids, or with `--courant` the largest with at most
this Courant number of the law. Prints root mean square distances of 2,000
tracers over the frames [mm], averaged over the scenes, and the core seconds of a forward simulation of all of them.
"""

import math
import time
from fractions import Fraction
from itertools import product
from pathlib import Path

import torch

from benchmarks.project_scenes import chosen_scenes, scene_parser, true_tracers
from neuma_lib.errors import NonFiniteError
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import write_json
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State


def error_of(
    settings, name: str, grid: int, particles: int, substeps: int, contact: str, courant: float | None = None
) -> tuple[float, float]:
    """Tracer RMSE [mm], infinite if it diverges, and core seconds of a scene."""
    scene = settings.scene(name)
    tracers, frames = true_tracers(settings, name)
    factor = Fraction(substeps * math.ceil(grid / settings.simulation.grid))
    if courant:
        given = MPM(grid, scene.dt).courant(analytic_law(scene.law.plain(), scene.dt), scene.density)
        interval = math.gcd(*frames)
        factor = Fraction(math.ceil(interval * given / courant), interval)
    model = MPM(grid, scene.dt / float(factor), contact=contact)
    mesh = place(scene.shape, scene.size, scene.height, scene.center)
    x = torch.as_tensor(sample_volume(mesh, particles, seed=7), dtype=torch.float32)
    vol0 = torch.full((len(x),), float(mesh.volume) / len(x))
    state = State.rigid(x, scene.density * vol0, vol0, scene.velocity, scene.spin)
    law = analytic_law(scene.law.plain(), model.dt)
    frames = [int(factor * n) for n in frames]
    before = time.process_time()
    try:
        with torch.no_grad():
            path = rollout(model, law, state, steps=frames[-1], frames=frames, tracers=tracers[0])
        error = tracer_errors(path.tracers, tracers)["tracer_rmse_mm"]
    except NonFiniteError:
        error = math.inf
    return error, time.process_time() - before


def main() -> None:
    parser = scene_parser(__doc__, "*")
    parser.add_argument("--grids", type=int, nargs="*", default=[24, 30, 36, 48])
    parser.add_argument("--particles", type=int, nargs="*", default=[1000, 2000, 4000, 8000])
    parser.add_argument("--substeps", type=int, nargs="*", default=[1])
    parser.add_argument("--courant", type=float, help="largest Courant number, instead of --substeps")
    parser.add_argument("--contacts", nargs="*", default=["particles"])
    parser.add_argument("--out", type=Path, help="JSON file for all numbers")
    args = parser.parse_args()
    torch.set_num_threads(1)
    scenes, rows = chosen_scenes(args), []
    names = list(scenes)
    print(
        f"{'contact':9} {'grid':>4} {'particles':>9} {'substeps':>8} {'mean mm':>8} {'core s':>7}  {' '.join(names)}"
    )
    for contact, grid, particles, substeps in product(
        args.contacts, args.grids, args.particles, args.substeps
    ):
        each = [
            error_of(settings, name, grid, particles, substeps, contact, args.courant)
            for name, settings in scenes.items()
        ]
        errors, seconds = zip(*each, strict=True)
        mean = sum(errors) / len(errors)
        rows.append({
            "contact": contact, "grid": grid, "particles": particles, "substeps": substeps,
            "rmse_mm": dict(zip(names, errors, strict=True)), "core_seconds": sum(seconds),
        })  # fmt: skip
        cells = " ".join(f"{error:.1f}" for error in errors)
        line = f"{contact:9} {grid:4} {particles:9} {substeps:8} {mean:8.2f} {sum(seconds):7.1f}  {cells}"
        print(line, flush=True)
        if args.out:
            write_json(args.out, rows)


if __name__ == "__main__":
    main()
