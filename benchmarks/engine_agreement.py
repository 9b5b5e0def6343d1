"""Agreement with Genesis, newton and MuJoCo: free motion of every family that maps, and a cube that falls on a floor.

    pip install mujoco "newton[sim,importers]" genesis-world      # docs/engines.md
    python -m benchmarks.engine_agreement free genesis           # contact-free motion, 0.1 s
    python -m benchmarks.engine_agreement free newton            # with names of return maps: these alone
    python -m benchmarks.engine_agreement free newton identity refine
    python -m benchmarks.engine_agreement drop out genesis newton mujoco      # folders, table and silhouettes in out/

Free motion: 1,728 particles in cells of 25 mm stretch and shear. All families of Genesis move in one scene, far apart.
newton's steps are implicit and its strains constant in a cell, so that both agree only when cell and step are refined.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import neuma_lib as nm
from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.export.materials import RULES, engine_material
from neuma_lib.export.scenes import EngineScene, export_scene

RHO, SPACING, GRID, SIDE, SECONDS = 1000.0, 0.0125, 40, 12, 0.1
MODULI = {"E": 3e4, "nu": 0.3}
CONSTANTS = {
    "identity": {},
    "von_mises": {"yield_stress": 300.0},
    "drucker_prager": {"friction_angle": 25.0},
    "cohesive_drucker_prager": {"friction_angle": 30.0, "cohesion": 60.0},
    "fluid_projection": {},
    "viscous_flow": {"viscosity": 4.0},
}
DROPS = {  # elasticity and time step [s] of each engine
    "genesis": ("neo_hookean", 5e-4),
    "newton": ("hencky", 2e-3),
    "mujoco": ("stvk", 5e-4),
}


def spec_of(elastic: str, plastic: str = "identity", **moduli: float) -> dict:
    return {
        "elasticity": {"name": elastic, **(moduli or MODULI)},
        "plasticity": {"name": plastic, **CONSTANTS[plastic]},
    }


def cube(dt: float, side: int = SIDE, refined: int = 1) -> EngineScene:
    sites = np.indices((side,) * 3).reshape(3, -1).T - (side - 1) / 2
    spacing, grid = SPACING / refined, GRID * refined
    x = sites * spacing
    v = x @ (1.5 * np.array([[0.0, 1.0, 0.0], [0.0, -0.6, 0.4], [-0.8, 0.0, 0.6]])).T
    vol0, steps = np.full(len(x), spacing**3), round(SECONDS / dt)
    return EngineScene(x + 0.5, v, RHO * vol0, vol0, dt, steps, steps, grid, gravity=(0.0, 0.0, 0.0))


def ours(scene: EngineScene, spec: dict, boundary: str = "slip") -> np.ndarray:
    """Positions (T, N, 3) [m]."""
    x, v, mass, vol0 = (torch.from_numpy(each).float() for each in (scene.x, scene.v, scene.mass, scene.vol0))
    mpm = nm.MPM(scene.grid, scene.dt, scene.gravity, boundary)
    frames = range(0, scene.steps + 1, scene.every)
    return nm.simulate(mpm, nm.Law.from_spec(spec, scene.dt), nm.State(x, v, mass, vol0), frames).x.numpy()


def millimetres(difference: np.ndarray) -> str:
    length = 1e3 * np.linalg.norm(difference, axis=1)
    return f"{np.sqrt(np.mean(length**2)):.4f} (largest {length.max():.4f})"


def free_genesis(dt: float = 5e-4) -> None:
    import genesis as gs

    gs.init(backend=gs.cpu, precision="32", logging_level="error")
    scene, families = cube(dt), list(RULES["genesis"])
    stage = gs.Scene(
        show_viewer=False,
        sim_options=gs.options.SimOptions(dt=dt, substeps=1, gravity=scene.gravity),
        mpm_options=gs.options.MPMOptions(
            grid_density=GRID,
            particle_size=SPACING,
            lower_bound=(-0.2,) * 3,
            upper_bound=(0.4 * len(families) + 0.8, 1.2, 1.2),
        ),
    )  # fmt: skip
    bodies = []
    for names in families:
        material = engine_material(spec_of(*names), RHO, dt, "genesis")
        own = getattr(gs.materials.MPM, material.kind.removeprefix("MPM."))(**material.arguments)
        bodies.append(stage.add_entity(gs.morphs.Nowhere(n_particles=len(scene.x)), own))
    stage.build()
    for k, body in enumerate(bodies):
        body.set_particles_pos((scene.x + [0.4 * k, 0, 0]).astype(np.float32))
        body.set_particles_vel(scene.v.astype(np.float32))
        body.set_particles_active(np.ones(len(scene.x), bool))
    for _ in range(scene.steps):
        stage.step()
    for k, (names, body) in enumerate(zip(families, bodies, strict=True)):
        x = body.get_particles_pos().cpu().numpy().reshape(-1, 3) - np.array([0.4 * k, 0, 0])
        own = ours(scene, spec_of(*names))
        print(f"genesis {' + '.join(names)}: moved {millimetres(own[-1] - own[0])} mm, "
              f"difference {millimetres(x - own[-1])} mm", flush=True)  # fmt: skip


def free_newton(families: list[str], refine: bool) -> None:
    """Difference in cells of 25 mm with 1 ms. With ``refine`` a smaller cube also in half of both."""
    import tempfile

    cases = ((1e-3, 8, 1), (5e-4, 16, 2)) if refine else ((1e-3, SIDE, 1),)
    for names in RULES["newton"]:
        if families and names[1] not in families:
            continue
        for dt, side, refined in cases:
            scene, spec = cube(dt, side, refined), spec_of(*names)
            with tempfile.TemporaryDirectory() as folder:
                export_scene(folder, "newton", scene, spec, {})
                subprocess.run([sys.executable, f"{folder}/run.py"], check=True, stdout=subprocess.DEVNULL)
                x = np.load(f"{folder}/motion.npz")["x"]
            own = ours(scene, spec)
            print(f"newton {' + '.join(names)}, {1e3 / scene.grid:g} mm, {1e3 * dt:g} ms: "
                  f"moved {millimetres(own[-1] - own[0])} mm, difference {millimetres(x[-1] - own[-1])} mm",
                  flush=True)  # fmt: skip


def drop(folder: Path, engines: list[str]) -> None:
    """Play a fall in each engine and here with its law, and write table.md, motions and silhouettes.png."""
    rows, pictures = [], []
    for engine in engines:
        elastic, dt = DROPS[engine]
        spec = spec_of(elastic, E=3e4, nu=0.4)
        scene = EngineScene.falling_cube(RHO, dt, 0.5)
        export_scene(folder / engine, engine, scene, spec, {})
        if not (folder / engine / "motion.npz").exists():
            subprocess.run([sys.executable, str(folder / engine / "run.py")], check=True)
        own = replace(scene, dt=5e-4, steps=1000, every=10)
        motion = np.load(folder / engine / "motion.npz")
        masses = motion["masses"] if "masses" in motion else np.ones(motion["x"].shape[1])
        for name, t, x, m in (
            (f"this library, {elastic}", np.arange(101) * 5e-3, ours(own, spec), np.ones(len(own.x))),
            (f"{engine}, {elastic}", motion["t"], motion["x"].astype(float), masses),
        ):
            centre = np.einsum("n,tn->t", m, x[:, :, 1]) / m.sum()
            speed, low = np.gradient(centre, t), int(centre.argmin())
            apex = low + int(centre[low:].argmax())
            numbers = 1e3 * centre[low], t[low], -speed.min(), speed[low:].max(), 1e3 * centre[apex]
            numbers = (*numbers, 1e3 * x[..., 1].min())
            rows.append([name, *map("{:.{}f}".format, numbers, (1, 3, 2, 2, 0, 0))])
            pictures.append((name, x[[low, apex]], (t[low], t[apex])))
    head = [
        "engine, law",
        "lowest centre [mm]",
        "at [s]",
        "down [m/s]",
        "up [m/s]",
        "apex [mm]",
        "lowest point [mm]",
    ]
    table = "\n".join(as_markdown(head, rows)) + "\n"
    (folder / "table.md").write_text(table)
    print(table)
    _draw(folder / "silhouettes.png", pictures)


def _draw(path: Path, pictures: list) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.2 * len(pictures), 4.4), layout="constrained")
    for axes, (name, states, times) in zip(
        figure.subplots(2, len(pictures), sharex=True, sharey=True).T, pictures
    ):
        for axis, x, t, word in zip(axes, states, times, ("lowest", "apex"), strict=True):
            axis.scatter(x[:, 0], x[:, 1], s=3, color="tab:blue", linewidths=0)
            axis.axhline(0, color="k", linewidth=0.8)
            axis.set(aspect="equal", xlim=(0.3, 0.7), ylim=(-0.03, 0.37), title=f"{name}\n{word}, {t:.3f} s")
            axis.title.set_fontsize(8)
    figure.savefig(path, dpi=110)


def main() -> None:
    torch.set_num_threads(1)
    what, *words = sys.argv[1:] or ["help"]
    if what == "free" and words[:1] == ["genesis"]:
        free_genesis()
    elif what == "free" and words[:1] == ["newton"]:
        free_newton([word for word in words[1:] if word != "refine"], "refine" in words)
    elif what == "drop" and words:
        Path(words[0]).mkdir(parents=True, exist_ok=True)
        drop(Path(words[0]), words[1:] or list(DROPS))
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
