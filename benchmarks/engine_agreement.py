"""Agreement with Genesis, newton and MuJoCo: free motion, a cube that falls on a floor, and exported scenes.

    make engines && pip install genesis-world                    # docs/engines.md
    python -m benchmarks.engine_agreement free genesis           # contact-free motion of every family, 0.1 s
    python -m benchmarks.engine_agreement free newton von_mises  # with names of return maps: these alone
    python -m benchmarks.engine_agreement drop out genesis newton mujoco      # folders, table and silhouettes in out/
    python -m benchmarks.engine_agreement scene out results/demo/SoftDuck/constants genesis newton

Free motion: 1,728 particles in cells of 25 mm stretch and shear. Every motion is played by the files that `neuma scene
export` writes. Folders with a motion are not played again.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

import neuma_lib as nm
from neuma_lib.cli import main as neuma
from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.export.materials import RULES
from neuma_lib.export.scenes import EngineScene, export_scene
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays

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
STEPS = {"genesis": 5e-4, "newton": 1e-3}  # time step of free motion [s]
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


def cube(dt: float, side: int = SIDE) -> EngineScene:
    sites = np.indices((side,) * 3).reshape(3, -1).T - (side - 1) / 2
    x = sites * SPACING
    v = x @ (1.5 * np.array([[0.0, 1.0, 0.0], [0.0, -0.6, 0.4], [-0.8, 0.0, 0.6]])).T
    vol0, steps = np.full(len(x), SPACING**3), round(SECONDS / dt)
    return EngineScene(x + 0.5, v, RHO * vol0, vol0, dt, steps, steps, GRID, gravity=(0.0, 0.0, 0.0))


def ours(scene: EngineScene, spec: dict, boundary: str = "slip") -> np.ndarray:
    """Positions (T, N, 3) [m]."""
    x, v, mass, vol0 = (torch.from_numpy(each).float() for each in (scene.x, scene.v, scene.mass, scene.vol0))
    mpm = nm.MPM(scene.grid, scene.dt, scene.gravity, boundary)
    frames = range(0, scene.steps + 1, scene.every)
    return nm.simulate(mpm, nm.Law.from_spec(spec, scene.dt), nm.State(x, v, mass, vol0), frames).x.numpy()


def played(folder: Path) -> dict[str, np.ndarray]:
    """Arrays ``t``, ``x`` and perhaps ``masses`` of an exported scene."""
    if not (folder / "motion.npz").exists():
        subprocess.run([sys.executable, "run.py"], cwd=folder, check=True, stdout=sys.stderr)
    with np.load(folder / "motion.npz") as motion:
        return dict(motion)


def millimetres(difference: np.ndarray) -> str:
    length = 1e3 * np.linalg.norm(difference, axis=1)
    return f"{np.sqrt(np.mean(length**2)):.4f} (largest {length.max():.4f})"


def free(engine: str, families: list[str]) -> None:
    """Print the distance between particles of an engine and of this library."""
    for names in RULES[engine]:
        if families and names[1] not in families:
            continue
        scene, spec = cube(STEPS[engine]), spec_of(*names)
        with TemporaryDirectory() as folder:
            export_scene(folder, engine, scene, spec, {})
            theirs = played(Path(folder))["x"]
        own = ours(scene, spec)
        moved, difference = (millimetres(each) for each in (own[-1] - own[0], theirs[-1] - own[-1]))
        print(f"{engine} {' + '.join(names)}: moved {moved} mm, difference {difference} mm", flush=True)


def drop(folder: Path, engines: list[str]) -> None:
    """Play a fall in each engine and here with its law, and write table.md, motions and silhouettes.png."""
    rows, pictures = [], []
    for engine in engines:
        elastic, dt = DROPS[engine]
        spec = spec_of(elastic, E=3e4, nu=0.4)
        scene = EngineScene.falling_cube(RHO, dt, 0.5)
        export_scene(folder / engine, engine, scene, spec, {})
        own, motion = replace(scene, dt=5e-4, steps=1000, every=10), played(folder / engine)
        for name, t, x, m in (
            (f"this library, {elastic}", np.arange(101) * 5e-3, ours(own, spec), np.ones(len(own.x))),
            (f"{engine}, {elastic}", motion["t"], motion["x"].astype(float), motion.get("masses")),
        ):
            centre = np.average(x[:, :, 1], axis=1, weights=m)
            speed, low = np.gradient(centre, t), int(centre.argmin())
            apex = low + int(centre[low:].argmax())
            numbers = 1e3 * centre[low], t[low], -speed.min(), speed[low:].max(), 1e3 * centre[apex]
            numbers = (*numbers, 1e3 * x[..., 1].min())
            rows.append([name, *map("{:.{}f}".format, numbers, (1, 3, 2, 2, 0, 0))])
            words = (f"lowest, {t[low]:.3f} s", f"apex, {t[apex]:.3f} s")
            pictures.append((name, x[[low, apex]], words))
    head = [
        "engine, law",
        "lowest centre [mm]",
        "at [s]",
        "down [m/s]",
        "up [m/s]",
        "apex [mm]",
        "lowest point [mm]",
    ]
    report(folder, head, rows, pictures)


def scene(folder: Path, source: str, engines: list[str], count: int = 4) -> None:
    """Play the scene of a method's folder in each engine, by its law or the nearest one, however far it is.

    Writes motions, table.md with distances between the centre and that of the true motion, and silhouettes.png. This
    library plays the law of the method, and the exported law, whose constants are those of the material.
    """
    filmed = nm.Scene.load(Path(source).absolute().parent)
    assert filmed.truth is not None, "a scene with a true motion is needed"
    own, _ = read_arrays(Path(source) / "rollout.h5", required=("x", "frames"))
    steps, motions = filmed.truth.frames, {}
    ours = {"true motion": (steps, filmed.truth.x.numpy()), "this library": (own["frames"], own["x"])}
    for engine in engines:
        for options in ([], ["--fit"], ["--fit", "--force"]):
            if neuma(["scene", "export", source, str(folder / engine), "--engine", engine, *options]) == 0:
                break
        about, name = read_json(folder / engine / "scene.json"), engine
        if about["fit"]:
            family, error = about["law"]["elasticity"]["name"], max(about["fit"].values())
            name = f"{engine}, {family}: stress error {100 * error:.0f} %"
        else:
            law = nm.Law.from_spec(about["law"], filmed.mpm.dt)
            path = nm.simulate(filmed.mpm, law, filmed.state(), steps)
            ours["this library, exported"] = (steps, path.x.numpy())
        motions[name] = played(folder / engine)
    motions = {name: {"t": np.array(n) * filmed.mpm.dt, "x": x} for name, (n, x) in ours.items()} | motions
    times, rows, pictures, true = motions["true motion"]["t"], [], [], None
    displayed = times[np.linspace(0, len(times) - 1, count).round().astype(int)]
    for name, motion in motions.items():
        t, x = motion["t"], motion["x"]
        centre = np.average(x, axis=1, weights=motion.get("masses"))
        centre = np.stack([np.interp(times, t, centre[:, k]) for k in range(3)], axis=1)
        true = centre if true is None else true
        distance = np.linalg.norm(centre - true, axis=1)
        rows.append(
            [name, *(f"{1e3 * each:.0f}" for each in (distance.mean(), distance.max(), centre[:, 1].min()))]
        )
        nearest = [int(np.abs(t - now).argmin()) for now in displayed]
        pictures.append((name.replace(", ", "\n"), x[nearest], [f"{t[k]:.3f} s" for k in nearest]))
    report(folder, ["engine", "centre, mean [mm]", "largest [mm]", "lowest centre [mm]"], rows, pictures)


def report(folder: Path, head: list[str], rows: list[list[str]], pictures: list) -> None:
    """Write table.md and silhouettes.png."""
    table = "\n".join(as_markdown(head, rows)) + "\n"
    (folder / "table.md").write_text(table)
    print(table)
    draw(folder / "silhouettes.png", pictures)


def draw(path: Path, pictures: list[tuple[str, np.ndarray, tuple[str, ...]]]) -> None:
    """Silhouettes in the plane z = 0: a column for each name, with states (K, N, 3) and their titles (K,)."""
    from matplotlib.figure import Figure

    rows, low = len(pictures[0][2]), min(x[..., 0].min() for _, x, _ in pictures) - 0.03
    high, top = (max(x[..., k].max() for _, x, _ in pictures) + 0.03 for k in (0, 1))
    figure = Figure(figsize=(2.2 * len(pictures), 2.2 * rows), layout="constrained")
    grid = figure.subplots(rows, len(pictures), sharex=True, sharey=True, squeeze=False)
    for axes, (name, states, titles) in zip(grid.T, pictures, strict=True):
        for axis, x, title in zip(axes, states, titles, strict=True):
            axis.scatter(x[:, 0], x[:, 1], s=6, color="tab:blue", linewidths=0)
            axis.axhline(0, color="k", linewidth=0.8)
            axis.set(aspect="equal", xlim=(low, high), ylim=(-0.03, top), title=f"{name}\n{title}")
            axis.title.set_fontsize(8)
    figure.savefig(path, dpi=110)


def main() -> None:
    torch.set_num_threads(1)
    what, *words = sys.argv[1:] or ["help"]
    if what == "free" and words and words[0] in STEPS:
        free(words[0], words[1:])
    elif what == "drop" and words:
        drop(Path(words[0]), words[1:] or list(DROPS))
    elif what == "scene" and len(words) > 1:
        scene(Path(words[0]), words[1], words[2:] or list(DROPS))
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
