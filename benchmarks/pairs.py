"""Two checkouts of the repository on one device, in turns: the same work in two processes that stay alive.

    python benchmarks/pairs.py OLD NEW [--device cuda] [--turns 5] [--small] [--only WORD ...] [--out FILE]

Each process imports its own checkout. The parent asks them in turns for one item at a time, so that other work on the
machine meets both. The first turn (compilation of kernels, CUDA graphs) is not counted. Prints a Markdown table of
medians [ms] and of the median, least and largest ratio OLD / NEW of the turns: above 1, NEW is faster.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path


def items(device_name, small):
    """Work by name; each entry returns {row: milliseconds}. Runs in a checkout, at c62e703 or later."""
    import torch

    torch.set_num_threads(1)
    from benchmarks import iteration, rasterizer, singular_values
    from benchmarks import rollout as rollouts
    from benchmarks.scene import Size, make_scene
    from benchmarks.timing import seconds
    from neuma_lib.mechanics.analytic import analytic_law
    from neuma_lib.sim.batch import rollout_batch
    from neuma_lib.sim.rollout import rollout
    from neuma_lib.splatting import compositor_cuda  # noqa: F401  (as the benchmark has it)

    try:
        from neuma_lib.sim.model import MPM
    except ImportError:
        from neuma_lib.sim.model import MPMModel as MPM

    device = torch.device(device_name)
    paper = (
        Size(particles=300, grid=16, steps=20, frames=4, gaussians=200, pixels=32, dt=1e-3)
        if small
        else Size()
    )
    scene = make_scene(paper, device)
    hencky = {"name": "hencky", "E": 1e4, "nu": 0.3}
    analytic = {
        "von_mises": {"elasticity": hencky, "plasticity": {"name": "von_mises", "yield_stress": 5e2}},
        "neo_hookean": {"elasticity": {**hencky, "name": "neo_hookean"}},
    }

    def best(work, times=3):
        return 1e3 * seconds(work, device, times)

    def whole(precision):
        def run():
            scene.law.set_adjoint_precision(precision)
            try:
                return {"": 1e3 * statistics.median(iteration.iterations(scene, 4 if small else 8)[3:])}
            finally:
                scene.law.set_adjoint_precision("single")

        return run

    def simulation():
        return {"": best(lambda: iteration.simulate_and_back(scene))}

    def parts():
        rows = iteration.simulation_parts(scene, device)
        rows += iteration.rendering_parts(scene, device, min(40, paper.frames))
        return {part.name.replace("there and back", "").strip(): 1e3 * part.seconds for part in rows}

    def laws(name, particles, grid, steps):
        def run():
            law = analytic_law(analytic[name]) if name in analytic else rollouts.soft_law(name, device)
            law = law.to(device)
            state = rollouts.falling_cube(particles, device)
            state.v.requires_grad_()
            frames = sorted({max(1, round(steps * (i + 1) / 20)) for i in range(20)})
            model = MPM(grid, 1e-3 if grid < 32 else 5e-4)

            def simulate():
                path = rollout(model, law, state, steps=steps, frames=frames, skip_free_flight=False)
                return path.x.square().mean() + path.F.square().mean()

            def forward():
                with torch.no_grad():
                    simulate()

            def both():
                law.zero_grad()
                state.v.grad = None
                simulate().backward()

            return {"forward": best(forward), "with backward": best(both)}

        return run

    def copies():
        count, particles, steps = (2, 200, 20) if small else (64, 2000, 300)
        spec = analytic["von_mises"]
        family = [
            analytic_law({**spec, "elasticity": {**hencky, "E": (1 + 0.01 * k) * 1e4}}, 5e-4)
            for k in range(count)
        ]
        start = rollouts.falling_cube(particles, device)
        run = dict(steps=steps, frames=range(0, steps + 1, 10), skip_free_flight=False)
        return {"": best(lambda: rollout_batch(MPM(24, 5e-4), family, start, **run), 2)}

    def drawing():
        tiles = "tiles" if device.type == "cuda" else "rows"
        gaussians, frames, pixels = (200, 2, 32) if small else (20_000, 40, 800)
        inputs, cameras = rasterizer.ball(gaussians, frames, 1, pixels, device)
        times = rasterizer.stages(tiles, inputs, cameras, 3 if small else 10)
        for appearance in (False, True):
            result, _ = rasterizer.whole(tiles, inputs, cameras, appearance, 3 if small else 10)
            label = "both" + ", with appearance" * appearance
            times |= {label: result["both"]}
        return {name: value for name, value in times.items() if name != "entries"}

    def svd():
        generator = torch.Generator().manual_seed(1)
        F = (torch.eye(3) + 0.1 * torch.randn(100 if small else 30_000, 3, 3, generator=generator)).to(device)
        return {"": best(lambda: singular_values.svd3(F), 30)}

    large = (300, 16, 20) if small else (30_000, 32, 400)
    little = (200, 16, 10) if small else (2000, 24, 100)
    work = {
        "iteration, paper's scale": whole("single"),
        "iteration, adjoints in half precision": whole("half"),
        "simulation and networks of it": simulation,
        "part": parts,
    }
    if device.type == "cpu":
        del work["iteration, adjoints in half precision"]
    for size in (large, little):
        for name in ("neural", "stretch", "von_mises", "neo_hookean"):
            work[f"rollout {size[0]} / {size[1]}³ / {size[2]}, {name}"] = laws(name, *size)
    work |= {"copies of von Mises": copies, "rasterizer": drawing, "SVD": svd}
    return work


def serve(device, small):
    """Answer each line, the name of an item, by one line of JSON."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print goes to the error stream
    work = items(device, small)
    print(json.dumps(list(work)), file=answers, flush=True)
    for line in sys.stdin:
        try:
            answer = work[line.strip()]()
        except Exception as error:  # an item that one commit cannot do must not end the others
            answer = {"error": f"{type(error).__name__}: {error}"[:200]}
        print(json.dumps(answer), file=answers, flush=True)


def child(checkout, site, options):
    path = os.pathsep.join([*site, str(Path(checkout).resolve())])
    env = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), "--serve", *options]
    pipes = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    return subprocess.Popen(command, cwd=checkout, env=env, **pipes)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkouts", nargs="*")
    parser.add_argument("--serve", action="store_true")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--small", action="store_true")
    parser.add_argument(
        "--site", default=os.environ.get("PYTHONPATH", ""), help="folders of packages, with colons"
    )
    parser.add_argument("--only", nargs="+", help="items whose names contain one of these")
    parser.add_argument("--limit", type=float, default=540, help="seconds after which no new turn starts")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.serve:
        return serve(args.device, args.small)
    started = time.monotonic()
    options = ["--device", args.device, *["--small"] * args.small]
    site = [folder for folder in args.site.split(os.pathsep) if folder]
    processes = [child(checkout, site, options) for checkout in args.checkouts]
    names = [json.loads(p.stdout.readline()) for p in processes][0]
    wanted = [n for n in names if not args.only or any(word in n for word in args.only)]
    times, errors = {}, {}

    def ask(which, name):
        processes[which].stdin.write(name + "\n")
        processes[which].stdin.flush()
        return json.loads(processes[which].stdout.readline())

    def turn(counted, order):
        for name in wanted:
            if time.monotonic() - started > args.limit:
                return
            answers = {which: ask(which, name) for which in order}
            for which, answer in answers.items():
                if "error" in answer:
                    errors[which, name] = answer["error"]
            if counted:
                for row in answers[0].keys() & answers[1].keys() - {"error"}:
                    label = f"{name}: {row}" if row else name
                    times.setdefault(label, []).append((answers[0][row], answers[1][row]))

    def table():
        lines = ["| [ms] | old | new | old / new (least, largest) |", "|---|---:|---:|---:|"]
        for label, pairs in sorted(times.items()):
            old, new = (statistics.median(p[k] for p in pairs) for k in (0, 1))
            ratios = [p[0] / p[1] for p in pairs]
            lines.append(
                f"| {label} | {old:.4g} | {new:.4g} | {statistics.median(ratios):.3f} "
                f"({min(ratios):.3f}, {max(ratios):.3f}) |"
            )
        lines += [
            f"FAILED in {args.checkouts[which]}: {name}: {error}" for (which, name), error in errors.items()
        ]
        return "\n".join(lines)

    turn(False, (0, 1))
    print(f"first turn: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    for k in range(args.turns):
        turn(True, (0, 1) if k % 2 else (1, 0))
        print(f"turn {k + 1}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
        if args.out:
            args.out.write_text(table() + "\n")
    print(table())
    for process in processes:
        process.stdin.close()
        process.wait()


if __name__ == "__main__":
    main()
