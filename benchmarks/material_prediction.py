"""Prediction of another shape at 3 m/s on a finer grid with identified constants.

python -m benchmarks.material_prediction RubberPawn_converged ClayCat_converged [--grid 64] [--truth 128]

In each scene with an identified.json, another shape of the same size falls on the floor at 3 m/s. Compared with the
true law on the grid of the truth: the true law, the constants of the material, and those of the grid that they were
fitted on, all on the grid of the prediction. Prints root mean square distances of 4,000 tracers over 25 frames [mm],
and those of the material relative to the true law.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from benchmarks.project_scenes import chosen_scenes, scene_parser, simulator
from neuma_lib.config.scenes import SceneConfig
from neuma_lib.data.ground_truth import TrueBody, simulate_ground_truth
from neuma_lib.errors import NonFiniteError
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.geometry.shapes import place
from neuma_lib.io.files import read_json
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.project.paths import result_path
from neuma_lib.sim.model import COURANT_LIMIT, MPM

SHAPES = ("ball", "duck", "pawn", "cat", "fish", "bottle")
SPEED = 3.0
FRAMES = 25


def other_shape(scene: SceneConfig) -> str:
    """The shape after that of a scene."""
    return SHAPES[(SHAPES.index(scene.shape) + 1) % len(SHAPES)]


def falling(model: MPM, scene: SceneConfig, spec: Mapping[str, Any], grid: int) -> Tensor:
    """Tracers (T, M, 3) of the other shape on a grid.

    Args:
        model: simulator of the scene, with its grid and time step.
        spec: law.

    Returns:
        Positions of tracers, which start at the same points on every grid.
    """
    mesh = place(other_shape(scene), scene.size, 0.5 * scene.size + 0.1, scene.center)
    factor = math.ceil(grid / model.grid) - 1
    courant = math.inf
    while courant > COURANT_LIMIT:  # a stiffness that the video does not determine may need smaller steps
        factor += 1
        dt = model.dt / factor
        law = analytic_law(spec, dt)
        fine = MPM(grid, dt, gravity=model.gravity, boundary=model.boundary, contact=model.contact)
        courant = fine.courant(law, scene.density)
    body = TrueBody(mesh, law, (0.0, -SPEED, 0.0), scene.density)
    frames = [factor * round(n * scene.steps / (FRAMES - 1)) for n in range(FRAMES)]
    device = "cuda" if torch.cuda.is_available() else "cpu"
    truth = simulate_ground_truth(
        fine, [body], frames, particles=None, tracers=4000, seed=1000, device=device
    )
    return truth.tracers


def main() -> None:
    parser = scene_parser(__doc__, "*")
    parser.add_argument("--grid", type=int, default=64, help="cells of the prediction")
    parser.add_argument("--truth", type=int, default=128, help="cells of the truth")
    parser.add_argument("--replicates", nargs="*", default=[""], help="suffixes of scenes, such as +seed=1")
    args = parser.parse_args()
    print(f"{'scene':40} {'shape':8} {'true law':>9} {'material':>9} {'on grid':>9} {'ratio':>6}")
    ratios = []
    for name, settings in chosen_scenes(args).items():
        scene = settings.scene(name)
        model = simulator(settings, scene)
        true = scene.law.plain()
        truth = falling(model, scene, true, args.truth)
        for suffix in args.replicates:
            identified = read_json(result_path(settings, name + suffix, "identified.json"))
            laws = {"true": true, "material": identified["material"]["law"], "grid": identified["law"]}
            errors = {}
            for key, spec in laws.items():
                try:
                    path = falling(model, scene, spec, args.grid)
                    errors[key] = tracer_errors(path, truth)["tracer_rmse_mm"]
                except NonFiniteError:
                    errors[key] = math.inf
            ratios.append(errors["material"] / errors["true"])
            cells = " ".join(f"{errors[key]:9.2f}" for key in laws)
            print(f"{name + suffix:40} {other_shape(scene):8} {cells} {ratios[-1]:6.2f}", flush=True)
    print(f"{sum(ratio <= 1.5 for ratio in ratios)} of {len(ratios)} within 1.5")


if __name__ == "__main__":
    main()
