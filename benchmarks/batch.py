"""Time of several rollouts that differ in their constants: one after the other, and in the same launches.

    python -m benchmarks.batch                         # 8 of 2,000 particles on a 24^3 grid, 300 steps
    python -m benchmarks.batch --copies 64 --device cuda
    python -m benchmarks.batch --particles 30000 --grid 32 --steps 400 --device cuda

On a CPU seconds of the core, on a GPU of the clock, of the fastest repetition. A batch of one is what the kernels of
analytic laws save by themselves.
"""

from __future__ import annotations

import time

import torch

from benchmarks.rollout import falling_cube
from benchmarks.timing import parser_of, seconds
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout

HENCKY = {"name": "hencky", "E": 1e5, "nu": 0.3}
SPECS = {
    "fixed corotated": {"elasticity": {**HENCKY, "name": "fixed_corotated"}},
    "von Mises": {"elasticity": HENCKY, "plasticity": {"name": "von_mises", "yield_stress": 2e3}},
    "Drucker-Prager": {
        "elasticity": HENCKY,
        "plasticity": {"name": "drucker_prager", "friction_angle": 40.0},
    },
    "viscous flow": {"elasticity": HENCKY, "plasticity": {"name": "viscous_flow", "viscosity": 20.0}},
}
FRAME_EVERY = 10  # steps


def laws_of(name: str, copies: int, dt: float) -> list[Law]:
    """A family with stiffnesses that differ by 1 % each."""
    spec = SPECS[name]
    elastic = spec["elasticity"]
    return [
        analytic_law({**spec, "elasticity": {**elastic, "E": (1 + 0.01 * copy) * elastic["E"]}}, dt, name)
        for copy in range(copies)
    ]


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--copies", type=int, default=8)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--grid", type=int, default=24)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--dt", type=float, default=5e-4)
    parser.add_argument("--total", action="store_true", help="carry the total deformation")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()

    torch.set_num_threads(1)
    device = torch.device(args.device)
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    model, start = MPM(args.grid, args.dt), falling_cube(args.particles, device)
    run = dict(
        steps=args.steps,
        frames=range(0, args.steps + 1, FRAME_EVERY),
        total=args.total,
        skip_free_flight=False,
    )
    print(
        f"{args.copies} rollouts of {args.particles} particles, {args.grid}^3 grid, {args.steps} steps, {device}; best "
        f"of {args.repetitions} [s]"
    )
    print(f"{'':20}{'rollouts':>12}{'batches of 1':>14}{'one batch':>12}{'ratio':>8}")
    for name in SPECS:
        laws = laws_of(name, args.copies, args.dt)
        rows = (
            lambda laws=laws: [rollout(model, law, start, **run) for law in laws],
            lambda laws=laws: rollout_batch(model, laws, start, **run, together=1),
            lambda laws=laws: rollout_batch(model, laws, start, **run),
        )
        alone, ones, together = (seconds(work, device, args.repetitions, clock) for work in rows)
        print(f"{name:20}{alone:12.3f}{ones:14.3f}{together:12.3f}{alone / together:8.2f}")


if __name__ == "__main__":
    main()
