"""Time of one training iteration's parts on this machine: rollout forward and backward, and rendering.

    python -m benchmarks.rollout                        # 2,000 particles, 24^3 grid, 100 steps, neural law
    python -m benchmarks.rollout --law stretch          # a structured law of that form, or energy
    python -m benchmarks.rollout --law von_mises        # an analytic law, or neo_hookean
    python -m benchmarks.rollout --render               # and 20 frames of 1,500 Gaussians at 64 px
    python -m benchmarks.rollout --particles 30000 --grid 32 --steps 400 --device cuda

The rollout is compared with the same kernels under one autograd function per step, the usual way to build a
differentiable simulator. The best of several repetitions counts: other load only adds time.
"""

import math
import time
from collections.abc import Callable

import torch

from benchmarks.timing import parser_of
from neuma_lib.coupling.deformation import deform
from neuma_lib.coupling.particle_binding import bind
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import FORMS, structured_law
from neuma_lib.sim.memory import MemoryPlan
from neuma_lib.sim.model import MPM, as_regions
from neuma_lib.sim.rollout import RolloutFunction, rollout
from neuma_lib.sim.simulation import Simulation, gather_weights
from neuma_lib.sim.state import State
from neuma_lib.splatting.rasterizer import rasterize


def rollout_step_by_step(model, law, state, frames):
    """Positions and deformation gradients at the frames, by a graph with a node per step.

    The same code as a rollout of one step after another: every node has its own buffers, keeps its state and
    computes the rest again. The adaptor is merged once, as in the rollout.
    """
    bodies = as_regions(law, len(state.x))
    weights, slices = gather_weights(bodies, state.x.dtype)
    now, seen = (*state.motion, state.stuck), []
    for n in range(1, frames[-1] + 1):
        step = Simulation(model, bodies, slices, state, 1, n - 1, MemoryPlan(1, False, 0))
        *after, _ = RolloutFunction.apply(step, [1], None, *now, *weights)
        now = tuple(value[0] for value in after)
        if n in frames:
            seen.append((now[0], now[2]))
    return torch.stack([x for x, _ in seen]), torch.stack([F for _, F in seen])


def falling_cube(count: int, device: torch.device) -> State:
    """Particles just above the floor that fall with one velocity."""
    generator = torch.Generator().manual_seed(0)
    side = 0.3
    x = torch.rand(count, 3, generator=generator) * side + torch.tensor([0.35, 0.1, 0.35])
    vol0 = torch.full((count,), side**3 / count)
    v = torch.tensor([0.3, -2.0, 0.1])
    return State(*(value.to(device) for value in (x, v, 1000 * vol0, vol0)))


SOFT = {
    "elasticity": {"name": "hencky", "E": 1e4, "nu": 0.3},
    "plasticity": {"name": "von_mises", "yield_stress": 5e2},
}


ANALYTIC = {"von_mises": SOFT, "neo_hookean": {"elasticity": {"name": "neo_hookean", "E": 1e4, "nu": 0.3}}}


def soft_law(name: str, device: torch.device) -> Law:
    """A law of little stiffness: analytic, or untrained with an adaptor, as in training, neural or structured."""
    if name in ANALYTIC:
        return analytic_law(ANALYTIC[name])
    if name == "neural":
        law = neural_law(seed=0)
        law.attach_adaptor(rank=16, alpha=16.0)
    else:
        law = structured_law({**SOFT, "form": name})
        law.attach_adaptor(rank=None)
    return law.to(device)


def picture(
    x0: torch.Tensor, gaussians: int, pixels: int
) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
    """A function of (x, F) at the frames that renders Gaussians bound to the particles."""
    generator = torch.Generator().manual_seed(1)
    chosen = torch.randint(len(x0), (gaussians,), generator=generator)
    means = x0[chosen.to(x0.device)]
    covars = (0.012**2 * torch.eye(3)).to(x0).expand(gaussians, 3, 3).contiguous()
    binding = bind(means, covars, x0)
    opacities = torch.full((gaussians,), 0.8).to(x0)
    sh = (0.3 * torch.randn(gaussians, 16, 3, generator=generator)).to(x0)
    viewmat = torch.tensor([[1.0, 0, 0, -0.5], [0, -1, 0, 0.3], [0, 0, -1, 1.9], [0, 0, 0, 1]]).to(x0)
    K = torch.tensor([[1.8 * pixels, 0, pixels / 2], [0, 1.8 * pixels, pixels / 2], [0, 0, 1]]).to(x0)

    def render(x: torch.Tensor, F: torch.Tensor) -> torch.Tensor:
        moved = deform(means, covars, binding, x0, x, F)
        return rasterize(*moved, opacities, sh, viewmat[None], K[None], pixels, pixels)[0]

    return render


def measure(
    rows: dict[str, Callable[[], torch.Tensor]], law: Law, repetitions: int
) -> dict[str, tuple[float, float]]:
    """Seconds of each row's fastest forward and backward pass, rows taken in turns.

    The first round (compilation, memory) does not count.
    """
    best = dict.fromkeys(rows, (float("inf"), float("inf")))
    for repetition in range(repetitions + 1):
        for name, forward in rows.items():
            law.zero_grad()
            times = [now()]
            loss = forward()
            times.append(now())
            loss.backward()
            times.append(now())
            if repetition:
                best[name] = min(best[name], (times[1] - times[0], times[2] - times[1]), key=sum)
    return best


def now() -> float:
    """Time [s] at which all work handed out so far is done."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--law", choices=["neural", *FORMS, *ANALYTIC], default="neural")
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--grid", type=int, default=24)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--render", action="store_true", help="also time binding and rasterizer")
    parser.add_argument("--gaussians", type=int, default=1500)
    parser.add_argument("--pixels", type=int, default=64)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1, help="of torch; more than one rarely helps")
    args = parser.parse_args()

    torch.set_num_threads(args.threads)
    device = torch.device(args.device)
    model = MPM(args.grid, 1e-3)
    law = soft_law(args.law, device)
    state = falling_cube(args.particles, device)
    state.v.requires_grad_()  # what an analytic law is differentiated for
    frames = sorted({max(1, round(args.steps * (i + 1) / args.frames)) for i in range(args.frames)})
    options = dict(steps=args.steps, frames=frames, skip_free_flight=False)

    def simulate(**more):
        path = rollout(model, law, state, **options, **more)
        return path.x, path.F

    def scalar(states):
        return sum((value**2).mean() for value in states)

    print(
        f"{args.particles} particles, {args.grid}^3 grid, {args.steps} steps, {len(frames)} frames, "
        f"{args.law} law, {device}; best of {args.repetitions} [ms]"
    )
    rows = {
        "rollout": lambda: scalar(simulate()),
        "rollout, states kept only": lambda: scalar(simulate(cache_bytes=0)),
        "rollout, everything kept": lambda: scalar(simulate(cache_bytes=math.inf)),
    }
    rows["one function per step"] = lambda: scalar(rollout_step_by_step(model, law, state, frames))
    if args.render:
        render = picture(state.x, args.gaussians, args.pixels)
        rows[f"rollout + {args.gaussians} Gaussians at {args.pixels} px"] = lambda: scalar(
            [render(*simulate())]
        )
    print(f"{'':36}{'forward':>10}{'backward':>10}{'sum':>10}{'a step':>10}")
    best = measure(rows, law, args.repetitions)
    for name, (ahead, back) in best.items():
        columns = "".join(f"{1e3 * t:10.1f}" for t in (ahead, back, ahead + back))
        print(f"{name:36}{columns}{1e3 * (ahead + back) / args.steps:10.2f}")
    ratio = sum(best["one function per step"]) / sum(best["rollout"])
    print(f"one function per step / rollout: {ratio:.2f}")


if __name__ == "__main__":
    main()
