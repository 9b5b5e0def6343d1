"""Time of one training iteration by part, on a CPU or a GPU.

    python -m benchmarks.iteration                      # the paper's scale on a GPU, the default scale on a CPU
    python -m benchmarks.iteration --particles 60000 --pixels 400
    python -m benchmarks.iteration --adjoint-precision half
    python -m benchmarks.iteration --whole --frames 100 # whole iterations alone

Every part is timed alone, on the state in the middle of the motion, and compared with a lower bound, the longer of
two measured times: that of moving its bytes (each input read once, each result written once) at the bandwidth of a
copy, and that of the operations of its networks at the rate of a matrix product. The whole simulation and the
rasterizer are also compared with plain torch code under autograd, at a size for which that is possible.
"""

import dataclasses
import math
import statistics
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks import torch_rasterizer, torch_simulation
from benchmarks.scene import SMALL, BenchmarkScene, Size, make_scene
from benchmarks.timing import (
    arithmetic,
    bandwidth,
    device_name,
    parser_of,
    peak_memory,
    seconds,
    seconds_a_call,
)
from neuma_lib.config.training import TrainingConfig
from neuma_lib.fitting.material import PixelLoss, train_material
from neuma_lib.sim.memory import MemoryPlan
from neuma_lib.sim.model import as_regions
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.simulation import Simulation, gather_weights
from neuma_lib.sim.state import Trajectory
from neuma_lib.sim.workspace import SORT_EVERY, free_pool
from neuma_lib.splatting.image_loss import mean_squared_error
from neuma_lib.splatting.rasterizer import rasterize

NETWORK = 2 * (13 * 64 + 64 * 64 + 64 * 9)  # operations of one network for one particle, forward


@dataclasses.dataclass(frozen=True)
class Part:
    """A line of the table.

    Attributes:
        name: of the part.
        seconds: time of one call.
        calls: calls in an iteration.
        bytes, operations: minimum that a call moves and computes.
    """

    name: str
    seconds: float
    calls: float
    bytes: float
    operations: float = 0.0

    def floor(self, rate: float, peak: float) -> float:
        """Shortest time of a call on a device of that bandwidth [B/s] and arithmetic [1/s]."""
        return max(self.bytes / rate, self.operations / peak)


def simulation_parts(scene: BenchmarkScene, device: torch.device) -> list[Part]:
    """The kernels of a step, forward and backward, on a state in contact."""
    size, law = scene.size, scene.law
    N, nodes = size.particles, size.grid**3
    middle = size.steps // 2
    with torch.no_grad():
        path = _roll(scene, steps=middle, frames=(middle,))
    bodies = as_regions(law, N)
    weights, slices = gather_weights(bodies, torch.float32)
    flat = [w.detach() for w in weights]
    elastic, plastic = flat[:3], flat[3:]
    plan = MemoryPlan(segment=2, caches_steps=True, law_cache_bytes=math.inf)
    sim = Simulation(scene.model, bodies, slices, scene.body.state(scene.v0), steps=2, plan=plan)
    ws = sim.workspace
    at_rest = (torch.zeros_like(states[0]) for states in ws.states[4:])  # tangential displacements in contact
    sim.run((path.x[0], path.v[0], path.F[0], path.C[0], *at_rest), flat, (2,))
    F, F_trial, tau = ws.F[0], ws.F_trial[0], ws.tau[0]
    for grad in (ws.grad_x, ws.grad_v, ws.grad_C, ws.grad_F):
        grad.normal_()
    if not ws.native:
        ws.grad_grid.zero_()
    grads = [torch.zeros_like(w) for w in flat]

    def on_stream(work: Callable[..., object], *args) -> Callable[[], None]:
        def call():
            with ws.stream():
                work(*args)

        return call

    def law_back(part, value, weights, grad_out, grad_in, totals):
        sums = part.accumulators(value, tuple(totals))  # added up once an iteration
        return lambda: part.vjp(value, weights, grad_out, grad_F=grad_in, grad_weights=sums)

    particle = 4.0 * N
    rows = [
        ("elasticity", lambda: law.elasticity.evaluate(F, elastic, tau), 18 * particle, NETWORK * N),
        (
            "plasticity",
            lambda: law.plasticity.evaluate(F_trial, plastic, ws.F[1]),
            18 * particle,
            NETWORK * N,
        ),
        ("P2G and grid", on_stream(ws.transfer_to_grid, 0), 26 * particle + 48 * nodes, 0),
        ("G2P", on_stream(ws.transfer_to_particles, 0), 36 * particle + 16 * nodes, 0),
        (
            "plasticity, adjoint",
            law_back(law.plasticity, F_trial, plastic, ws.grad_F, ws.grad_F_trial, grads[3:]),
            27 * particle,
            3 * NETWORK * N,
        ),
        ("transfers, adjoint", on_stream(ws.transfer_adjoint, 0), (60 + 53) * particle + 80 * nodes, 0),
        (
            "elasticity, adjoint",
            law_back(law.elasticity, F, elastic, ws.grad_tau, ws.grad_F_elastic, grads[:3]),
            27 * particle,
            3 * NETWORK * N,
        ),
    ]
    parts = [
        Part(name, seconds_a_call(work, device), size.steps, moved, operations)
        for name, work, moved, operations in rows
    ]
    if ws.sorts:
        parts.append(
            Part(
                "sorting by cell",
                seconds_a_call(on_stream(ws.sort, 0), device),
                size.steps / SORT_EVERY,
                8 * particle,
            )
        )
    return parts


def rendering_parts(scene: BenchmarkScene, device: torch.device, frames: int) -> list[Part]:
    """Binding, rasterizer and loss of a batch of frames, forward and backward."""
    size, body = scene.size, scene.body
    with torch.no_grad():
        path = _roll(scene, steps=size.steps, frames=size.frame_steps[-frames:])
    x, F = path.x.requires_grad_(), path.F.requires_grad_()
    renderer = body.particle_gs(scene.observation.cameras)
    N, G, pixels = size.particles, size.gaussians, size.pixels**2
    means, covars = renderer.deformed(x, F)
    inputs = [t.detach().requires_grad_() for t in (means, covars)]
    seen = scene.observation.images[len(size.frame_steps) - frames :]
    losses = renderer.splatted_error(*inputs, seen)
    calls = len(size.frame_steps) / frames
    deformed = 4.0 * frames * G * 12
    states = 4.0 * frames * N * 12
    observed = 4.0 * frames * pixels

    def back(outputs, leaves, grads):
        return lambda: torch.autograd.grad(outputs, leaves, grads, retain_graph=True)

    grad_deformed = [torch.randn_like(t) for t in (means, covars)]
    rows = [
        ("binding", lambda: renderer.deformed(x.detach(), F.detach()), states + deformed),
        ("binding, adjoint", back((means, covars), (x, F), grad_deformed), states + deformed),
        (
            "rasterizer and loss",
            lambda: renderer.splatted_error(*(t.detach() for t in inputs), seen),
            deformed + observed,
        ),
        ("rasterizer and loss, adjoint", back(losses, inputs, torch.ones_like(losses)), 2 * deformed),
    ]
    return [Part(name, seconds(work, device), calls, moved) for name, work, moved in rows]


def compared_renders(scene: BenchmarkScene, device: torch.device, frames: int) -> tuple[float, float]:
    """Time of the loss of a batch of frames at rest and its gradient [s]: by `error`, and by way of images."""
    body = scene.body
    x = body.x0.expand(frames, -1, -1)
    renderer = body.particle_gs(scene.observation.cameras)
    with torch.no_grad():
        deformed = renderer.deformed(x, torch.eye(3).to(x).expand(*x.shape, 3))
    inputs = [t.detach().requires_grad_() for t in deformed]
    seen = scene.observation.images[:frames]

    def drawn() -> torch.Tensor:
        return renderer.splatted_error(*inputs, seen)

    def by_images() -> torch.Tensor:
        return mean_squared_error(renderer.splatted(*inputs), seen)

    return tuple(
        seconds(lambda f=f: torch.autograd.grad(f().sum(), inputs), device) for f in (drawn, by_images)
    )


def _roll(scene: BenchmarkScene, **options) -> Trajectory:
    return rollout(scene.model, scene.law, scene.body.state(scene.v0), skip_free_flight=False, **options)


def simulate_and_back(scene: BenchmarkScene, **options) -> None:
    """One rollout of all steps and its adjoint."""
    path = _roll(scene, steps=scene.size.steps, frames=scene.size.frame_steps, **options)
    scene.law.zero_grad()
    (path.x.square().mean() + path.F.square().mean()).backward()


def iterations(scene: BenchmarkScene, count: int) -> list[float]:
    """Wall time of each of some training iterations [s], by the training loop itself."""
    loss = PixelLoss(scene.body, scene.observation)
    precision = scene.law.elasticity.adjoint_precision
    settings = TrainingConfig(iterations=count, lr_elastic=1e-4, lr_plastic=1e-5, adjoint_precision=precision)
    trained = train_material(
        scene.model, scene.law, scene.body.state(scene.v0), loss, settings, log=lambda _: None
    )
    return trained.history.seconds


def twin_step(scene: BenchmarkScene, device: torch.device, steps: int = 5) -> float:
    """Time of a step and its gradient by the plain torch twin [s]."""
    state = scene.body.state(scene.v0)

    def work():
        x, *_ = torch_simulation.rollout(scene.model, scene.law, state, (steps,))
        scene.law.zero_grad()
        x.square().mean().backward()

    return seconds(work, device, repetitions=2) / steps


def twin_render(device: torch.device) -> tuple[float, float]:
    """Time of a small render and its gradient by the plain torch twin and by the rasterizer [s]."""
    scene = make_scene(dataclasses.replace(SMALL, gaussians=300, pixels=48, frames=1), device)
    body, cameras = scene.body, scene.observation.cameras
    gaussians = body.gaussians
    means = gaussians.means[None].clone().requires_grad_()
    covars = gaussians.covars()[None].detach()
    rest = (gaussians.opacities, gaussians.sh(), cameras.viewmats, cameras.Ks, cameras.width, cameras.height)

    def work(render):
        image, _ = render(means, covars, *rest)
        torch.autograd.grad(image.square().mean(), means)

    return tuple(seconds(lambda r=r: work(r), device, 2) for r in (torch_rasterizer.rasterize, rasterize))


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    for field in dataclasses.fields(Size):
        parser.add_argument(f"--{field.name}", type=type(field.default), help=f"{field.default} on a GPU")
    parser.add_argument(
        "--batch", type=int, default=40, help="frames that are rendered at a time in the parts"
    )
    parser.add_argument(
        "--adjoint-precision",
        default="single",
        choices=("single", "half"),
        help="of the products in the networks' adjoints, as the setting of the stage material",
    )
    parser.add_argument("--whole", action="store_true", help="time whole iterations and the simulation alone")
    parser.add_argument("--output", type=Path, help="also write the table there, as Markdown")
    args = parser.parse_args()
    torch.set_num_threads(1)
    device = torch.device(args.device)
    given = {f.name: value for f in dataclasses.fields(Size) if (value := getattr(args, f.name)) is not None}
    size = dataclasses.replace(Size() if device.type == "cuda" else SMALL, **given)
    scene = make_scene(size, device)
    scene.law.set_adjoint_precision(args.adjoint_precision)
    lines = (
        whole(scene, device) if args.whole else report(scene, device, min(args.batch, len(size.frame_steps)))
    )
    print("\n".join(lines))
    if args.output:
        args.output.write_text("\n".join(lines) + "\n")


def whole(scene: BenchmarkScene, device: torch.device) -> list[str]:
    """Fastest and median of six iterations after three, and the time of the simulation alone."""
    times = iterations(scene, 9)[3:]
    simulation = seconds(lambda: simulate_and_back(scene), device)
    return [
        f"{len(scene.size.frame_steps)} renders, {device_name(device)}: {1e3 * min(times):.1f} ms an iteration (median "
        f"{1e3 * statistics.median(times):.1f}), simulation and networks {1e3 * simulation:.1f} ms"
    ]


def report(scene: BenchmarkScene, device: torch.device, batch: int) -> list[str]:
    """The table, line by line, in Markdown."""
    size = scene.size
    rate, peak = bandwidth(device), arithmetic(device)
    parts = [*simulation_parts(scene, device), *rendering_parts(scene, device, batch)]
    simulation = seconds(lambda: simulate_and_back(scene), device)
    states = 4.0 * 24 * size.particles * (size.steps + 1)  # bytes, of all steps
    bounded = seconds(lambda: simulate_and_back(scene, memory=states / 2), device, 3)
    free_pool()  # so that the peak is that of training alone
    times = []
    memory = peak_memory(lambda: times.extend(iterations(scene, 8)), device)
    fastest = min(times[3:])
    total = sum(part.seconds * part.calls for part in parts)
    lines = [
        f"{size.particles} particles, {size.grid}³ grid, {size.steps} steps, {len(size.frame_steps)} renders of "
        f"{size.gaussians} Gaussians at {size.pixels}×{size.pixels}, float32, {device_name(device)}; copy "
        f"{rate / 1e12:.2f} TB/s, matrix product {peak / 1e12:.2f} TFLOP/s; adjoints of the networks in "
        f"{scene.law.elasticity.adjoint_precision} precision.",
        "",
        "| part | a call [µs] | calls | iteration [ms] | share | floor of a call [µs] | call / floor |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for part in parts:
        floor = part.floor(rate, peak)
        lines.append(
            f"| {part.name} | {1e6 * part.seconds:.1f} | {part.calls:.0f} | {1e3 * part.seconds * part.calls:.1f} | "
            f"{100 * part.seconds * part.calls / total:.0f} % | {1e6 * floor:.1f} | {part.seconds / floor:.1f} |"
        )
    gibibytes = f"{memory / 2**30:.2f} GiB"
    step, (slow, fast) = twin_step(scene, device), twin_render(device)
    drawn, by_images = compared_renders(scene, device, batch)
    lines += [
        f"| **sum of the parts** | | | {1e3 * total:.1f} | 100 % | | |",
        "",
        "| whole | time | torch twin | twin / ours |",
        "|---|---:|---:|---:|",
        f"| training iteration | {1e3 * fastest:.1f} ms, {gibibytes} | | |",
        f"| simulation and networks, forward and backward | {1e3 * simulation:.1f} ms | {step * size.steps:.2f} s | "
        f"{step * size.steps / simulation:.0f} |",
        f"| the same with half of the memory for states | {1e3 * bounded:.1f} ms | | |",
        f"| rasterizer and loss of {batch} frames at rest, forward and backward | {1e3 * drawn:.2f} ms | | |",
        f"| the same by way of images | {1e3 * by_images:.2f} ms | | |",
        f"| one image of 300 Gaussians at 48×48 and its gradient | {1e3 * fast:.2f} ms | {1e3 * slow:.0f} ms | "
        f"{slow / fast:.0f} |",
    ]
    return lines


if __name__ == "__main__":
    main()
