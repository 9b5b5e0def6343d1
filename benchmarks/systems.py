"""Other methods compared with known truths: error of tracers, and time of the fit.

    python -m benchmarks.systems JellyDuck                                 # reads data/, results/, config/config.yaml
    python -m benchmarks.systems random1_04 --methods spring_gaus spring_gaus+truncated=true+iterations=10
    python -m benchmarks.systems random1_04 --methods pac_nerf pac_nerf+guesses=prior --fields FOLDER

A scene may be named by the beginning of its name. Dataset and reconstruction must exist (`snakemake
results/SCENE/velocity.json`). A radiance field that is missing (`.../pac_nerf/field.safetensors`) is fitted and kept in
the folder of --fields. Only the comparison reads the truth. Tune settings on scenes that are not reported.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from benchmarks.project_scenes import chosen_scenes, scene_parser, simulation, simulator, true_tracers
from benchmarks.timing import core_seconds
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.images import load_views
from neuma_lib.io.particles import load_initial_state
from neuma_lib.methods.base import FitRun, Problem, body_of_each_video
from neuma_lib.methods.pac_nerf.field_fit import fit_radiance_field
from neuma_lib.methods.pac_nerf.io import save_field
from neuma_lib.project import cases
from neuma_lib.project.settings import Config


class Run(FitRun):
    """A fit on the CPU that writes to a folder and keeps its last message."""

    def __init__(self, folder: Path, product: str):
        self.device = torch.device("cpu")
        self.product, self.history = folder / product, folder / "history.json"
        self.message = ""

    def checkpoint(self, settings, inputs):
        return Checkpoint(self.product.with_name("checkpoint.pt"), {})

    def progress(self, done, total, loss=None):
        pass

    def log(self, text):
        self.message = text


def measure(name: str, settings: Config, method: str, fields: Path) -> str:
    """Fit a method to one scene and compare its motion with the truth; a line."""
    case, scene = cases.case(settings, name, method), settings.scene(name)
    files = case.method.fit_inputs(case)
    if "field" in files:
        files["field"] = _field(case.result("pac_nerf/field.safetensors"), name, settings, fields)
    exposure = {"dt": scene.dt, "exposure_samples": settings.dataset.exposure_samples}
    problem = Problem(simulation(settings, scene), case.densities, exposure, settings.seed)
    with TemporaryDirectory() as folder:
        run = Run(Path(folder), case.method.product)
        before = core_seconds()
        case.method.fit(files, case.method.fit_options(case), problem, run)
        seconds = core_seconds() - before
        own = {case.product(): str(run.product)}
        inputs = {key: own.get(path, path) for key, path in case.method.model_inputs(case).items()}
        model = case.method.load(inputs, case.method.model_options(case), scene.dt)
        start = own.get(case.method.start_file(case), case.method.start_file(case))
        errors, failure = _errors(case, start, settings, model)
        text = f"{errors['tracer_rmse_mm']:.2f} mm, last frame {errors['tracer_rmse_last_mm']:.2f} mm"
        if start in own.values():
            estimated, _ = _errors(case, case.result("velocity.json"), settings, model)
            text += f" (from the estimated initial motion: {estimated['tracer_rmse_mm']:.2f} mm)"
    text += f", {seconds:.0f} core s; {run.message}"
    return f"{name} {method}: {text}" + (f"; a particle {failure.happened}" if failure else "")


def _errors(case, start: str, settings: Config, model):
    """Errors of tracers that start as those of the truth, and how the prediction failed, if it did."""
    tracers, frames = true_tracers(settings, case.scene)
    tracers = tracers.to(torch.float32)
    state, _ = load_initial_state(*body_of_each_video(case).values(), start, case.densities)
    mpm = simulator(settings, settings.scene(case.scene))
    path, failure = model.predict(mpm, state, tuple(frames), tracers[0])
    return tracer_errors(path.tracers, tracers), failure


def _field(file: str, name: str, settings: Config, fields: Path | None) -> str:
    """The radiance field of a scene, fitted if it is missing."""
    path = Path(file) if fields is None else fields / name / "pac_nerf/field.safetensors"
    if not path.exists():
        views = load_views(Path(settings.data_root) / name / "static/transforms.json")
        save_field(path, fit_radiance_field(*views, settings.radiance, settings.seed)[0], {})
    return str(path)


def main() -> None:
    parser = scene_parser(__doc__, nargs="+")
    parser.add_argument(
        "--methods", nargs="+", default=["spring_gaus"], help="presets or variants with a fit"
    )
    parser.add_argument("--fields", type=Path, help="folder of radiance fields, instead of that of results")
    args = parser.parse_args()
    torch.set_num_threads(1)
    chosen = chosen_scenes(args)
    if not chosen:
        parser.error("there is no such scene")
    for name, settings in chosen.items():
        for method in args.methods:
            if cases.kind_of(settings, method).product is None:
                parser.error(f"{method} has no fit")
            print(measure(name, settings, method, args.fields), flush=True)


if __name__ == "__main__":
    main()
