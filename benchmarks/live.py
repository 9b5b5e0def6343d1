"""Rate of the viewer's live mode on this machine: frames a second and pace, with the pictures that the viewer makes.

    taskset -c 0 python -m benchmarks.live                  # 2,000 particles, 24^3 grid, on one core
    taskset -c 0 python -m benchmarks.live --law structured
    python -m benchmarks.live --device cuda                 # also --particles 30000 --grid 32 --dt 5e-4

The simulation has its own thread, as in the viewer, and another one makes the Gaussians of every frame that it sees,
or the stresses of its particles. Transfer to a browser and drawing there are excluded.

The viewer never runs faster than real time, so the steps of a frame are also timed without its clock: real time over
the best and the median time of some frames. Other load affects all wall times and hardly the processor times. The last
column uses the latter: the share of real time of the steps that fit, with one picture, into 0.1 s of one core.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import torch

from benchmarks.rollout import SOFT
from benchmarks.scene import SMALL, BenchmarkScene, make_scene
from benchmarks.timing import device_name, parser_of, synchronize
from neuma_lib.coupling.deformation import arms_at_rest, deform
from neuma_lib.device import choose_device
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from neuma_lib.viewer import scalars
from neuma_lib.viewer.live import FRAME, LiveSimulation, Snapshot

WARM = 4.0
"""Seconds before anything is measured: kernels are loaded, and the number of steps a frame settles."""
FRAMES = 20  # frames that are timed without the viewer's clock, after two that load kernels
ASKED = 0.1  # time of a frame at ten frames a second [s]


def law_of(name: str, scene: BenchmarkScene) -> Law:
    """The scene's networks with their adaptor, a structured law with its correction, or an analytic one."""
    if name == "neural":
        return scene.law
    if name == "analytic":
        return analytic_law(SOFT, dt=scene.model.dt)
    law = structured_law({**SOFT, "form": "energy"})
    law.attach_adaptor(rank=None)
    return law


def unpaced(model: MPM, law: Law, state: State) -> tuple[int, list[float]]:
    """Steps of a frame in real time, and times of some such frames at full speed [s]."""
    steps, spans = max(1, round(FRAME / model.dt)), []
    for _ in range(FRAMES + 2):
        began = time.perf_counter()
        with torch.no_grad():
            path = rollout(model, law, state, steps=steps, frames=[steps], total=True)
        x, v, F, C = (value[-1] for value in (path.x, path.v, path.F, path.C))
        state = replace(state, x=x, v=v, F=F, C=C)
        synchronize(x.device)
        spans.append(time.perf_counter() - began)
    return steps, spans[2:]


def measured(
    live: LiveSimulation, draw: Callable[[Snapshot], object] | None, seconds: float
) -> tuple[float, ...]:
    """Frames a second, pace, and milliseconds of the processor that a step and a picture take."""
    first = last = live.wait(live.snapshot.number + 1)
    began, processor, pictures, drawing = time.perf_counter(), time.process_time(), 0, 0.0
    while time.perf_counter() - began < seconds:
        last = live.wait(last.number + 1)
        at = time.thread_time()
        if draw:
            draw(last)
        drawing, pictures = drawing + time.thread_time() - at, pictures + 1
    span, used = time.perf_counter() - began, time.process_time() - processor - drawing
    if last.trouble:
        raise SystemExit(f"the simulation stopped: {last.trouble}")
    moved, frames = last.time - first.time, last.number - first.number
    return frames / span, moved / span, 1e3 * used * first.dt / moved, 1e3 * drawing / pictures


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--law", default="neural", choices=("neural", "structured", "analytic"))
    parser.add_argument("--particles", type=int, default=SMALL.particles)
    parser.add_argument("--gaussians", type=int, default=SMALL.gaussians)
    parser.add_argument("--grid", type=int, default=SMALL.grid)
    parser.add_argument("--dt", type=float, default=SMALL.dt)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    device = choose_device(chosen.device)
    sizes = {name: getattr(chosen, name) for name in ("particles", "gaussians", "grid", "dt")}
    scene = make_scene(replace(SMALL, **sizes), torch.device("cpu"))
    law, body = law_of(chosen.law, scene).requires_grad_(False).to(device), scene.body
    g, model = body.gaussians, scene.model
    covars, arms = g.covars(), arms_at_rest(g.means, body.binding, body.x0)
    start = body.state(scene.v0)
    kinds = {
        "simulation alone": None,
        "and Gaussians": lambda s: deform(
            g.means, covars, body.binding, body.x0, s.x[None], s.F[None], arms=arms
        ),
        "and particles by stress": lambda s: scalars.von_mises(law, s.F.to(device)),
    }
    constants = {"grid": model.grid, "boundary": model.boundary, "contact": model.contact}
    print(
        f"{len(body.x0)} particles, {len(g)} Gaussians, {model.grid}^3 grid, step {1e3 * model.dt:g} ms, "
        f"{chosen.law} law, {device_name(device)}"
    )
    steps, spans = unpaced(model, law, start.to(device))
    best, median = (1e3 * find(spans) for find in (min, statistics.median))
    pace, usual = (1e3 * steps * model.dt / span for span in (best, median))
    print(
        f"a frame of {steps} steps without the viewer's clock: {best:.2f} ms, {pace:.2f} x real time (best of "
        f"{FRAMES}); {median:.2f} ms, {usual:.2f} x (median)"
    )
    live = LiveSimulation(constants, start.to(device), law, model.dt).open()
    print(
        f"{'':26}{'frames/s':>10}{'x real time':>13}{'CPU ms a step':>15}{'a picture':>11}{'x at 10 frames/s':>18}"
    )
    for name, draw in kinds.items():
        live.reset()
        live.launch(scene.v0.tolist())
        measured(live, draw, WARM)
        frames, pace, step, picture = measured(live, draw, chosen.seconds)
        fitting = int((1e3 * ASKED - picture) / step)
        allowed = f"{min(fitting * model.dt / ASKED, 1.0):.2f}" if device.type == "cpu" else "-"
        print(f"{name:26}{frames:10.1f}{pace:13.2f}{step:15.2f}{picture:11.2f}{allowed:>18}")
    live.close()


if __name__ == "__main__":
    main()
