"""Other systems judged against known truths: how far tracers are off, in what time. Spring-Gaus, PAC-NeRF, choices.

    python -m benchmarks.systems JellyDuck                                 # reads data/, results/, config/config.yaml
    python -m benchmarks.systems random1_04 --methods spring_gaus spring_gaus+truncated=true+iterations=10
    python -m benchmarks.systems random1_04 --methods pac_nerf pac_nerf+guesses=prior --fields FOLDER

A scene may be named by the beginning of its name. Dataset and reconstruction must exist (`snakemake
results/SCENE/velocity.json`), and for PAC-NeRF the field (`.../pac_nerf/field.safetensors`), or it is fitted and kept
in the folder of --fields. The truth is read here; nothing is fitted to it. Settings are to be tuned on draws that
are not reported.
"""

from __future__ import annotations

import resource
from pathlib import Path

import torch

from benchmarks.project_scenes import chosen_scenes, scene_parser, simulator
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.evaluation.motion import predict
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_observation, load_views
from neuma_lib.io.particles import load_body, with_motion
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.methods.pac_nerf.carried_field import CarriedField
from neuma_lib.methods.pac_nerf.families import choose_family
from neuma_lib.methods.pac_nerf.field_fit import fit_radiance_field
from neuma_lib.methods.pac_nerf.fit import fit_pac_nerf
from neuma_lib.methods.pac_nerf.io import load_field, save_field
from neuma_lib.methods.spring_gaus.body import SpringBody
from neuma_lib.methods.spring_gaus.evaluation import predict_springs
from neuma_lib.methods.spring_gaus.fit import fit_springs
from neuma_lib.methods.spring_gaus.network import Springs
from neuma_lib.methods.spring_gaus.rollout import SpringModel
from neuma_lib.project.settings import Config

TRACERS = 2000  # of the truth's, for the motion


def judge_pac_nerf(name: str, settings: Config, method: str, fields: Path) -> str:
    """Find velocity and constants of a method on one scene and compare with its truth; a line."""
    scene = settings.scene(name)
    data, results = Path(settings.data_root) / name, Path(settings.results_root) / name
    material, how = settings.method_material(name, method), settings.method_pac_nerf(method)
    density, model = scene.plain()["density"], simulator(settings, scene)
    file, found = fields / name / "pac_nerf/field.safetensors", read_json(results / "velocity.json")
    if not file.exists():
        fitted, _ = fit_radiance_field(
            *load_views(data / "static/transforms.json"), settings.radiance, settings.seed
        )
        save_field(file, fitted, {})
    field, _ = load_field(file)
    law = settings.priors.laws.get(settings.method_prior(name, method))
    before = _core_seconds()
    family, constants = choose_family(how, law.plain() if law else None)
    carried = CarriedField(field, settings.radiance.spacing, settings.radiance.least_opacity, how, density)
    video = load_observation(data / "dynamic/transforms.json", material.views).to(torch.float32)
    fit = fit_pac_nerf(model, carried, video, found["frames"][-1], constants, how, settings.seed)
    seconds = _core_seconds() - before
    files = (results / file for file in ("particles.h5", "binding.h5", "gaussians.ply"))
    body, truth = load_body(*files, density).to(torch.float32), _tracers(data)
    law = analytic_law(constants.specification(), dt=model.dt)
    errors = {}
    for start in (body.state(fit.velocity), with_motion(body, results / "velocity.json")):
        path, failure = predict(model, law, start, video.frames, truth[0])
        errors[len(errors)] = tracer_errors(path.tracers, truth)
    said = f"{errors[0]['tracer_rmse_mm']:.2f} mm, last frame {errors[0]['tracer_rmse_last_mm']:.2f} mm (thrown as our"
    said += (
        f" estimate: {errors[1]['tracer_rmse_mm']:.2f} mm), {seconds:.0f} core s; {family}, {fit.summary()}"
    )
    return f"{name} {method}: {said}" + (f"; a particle {failure.happened}" if failure else "")


def judge(name: str, settings: Config, method: str) -> str:
    """Fit the springs of a method on one scene and compare with its truth; a line."""
    scene = settings.scene(name)
    data, results = Path(settings.data_root) / name, Path(settings.results_root) / name
    material, how = settings.method_material(name, method), settings.method_springs(method)
    files = (results / file for file in ("particles.h5", "binding.h5", "gaussians.ply"))
    body = load_body(*files, scene.plain()["density"], gaussian_motion=material.gaussian_motion).to(
        torch.float32
    )
    video = load_observation(data / "dynamic/transforms.json", material.views).to(torch.float32)
    start, density = with_motion(body, results / "velocity.json"), float(body.mass.sum() / body.vol0.sum())
    network = (how.anchors, how.neighbours, how.hard_springs, how.exponent, how.carriers)
    model = SpringModel.of(simulator(settings, scene), how.substeps)
    before = _core_seconds()
    anchored = SpringBody.of(body.x0, *network)
    springs = Springs.of_modulus(anchored.network, how.guess, density, how.resistance, how.gap)
    loss = PixelLoss(body, video, material.covariance_gradient)
    fitted = fit_springs(model, anchored, springs, start, loss, material, how)
    seconds = _core_seconds() - before
    truth = _tracers(data)
    path, failure = predict_springs(model, anchored, springs, start, video.frames, truth[0], how.carriers)
    found = tracer_errors(path.tracers, truth)
    said = f"{found['tracer_rmse_mm']:.2f} mm, last frame {found['tracer_rmse_last_mm']:.2f} mm"
    said += f", {seconds:.0f} core s; {fitted.summary(density)}"
    return f"{name} {method}: {said}" + (f"; a particle {failure.happened}" if failure else "")


def _tracers(data: Path) -> torch.Tensor:
    """Some of the truth's tracers, (T, M, 3) [m]."""
    arrays, _ = read_arrays(data / "particles.h5", required=("tracers",), only=("tracers",))
    truth = torch.from_numpy(arrays["tracers"]).to(torch.float32)
    return truth[:, :: max(1, truth.shape[1] // TRACERS)]


def _core_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = scene_parser(__doc__, nargs="+")
    parser.add_argument(
        "--methods",
        nargs="+",
        default=["spring_gaus"],
        help="methods or variants with springs, or of PAC-NeRF",
    )
    parser.add_argument("--fields", type=Path, help="folder of radiance fields, instead of that of results")
    args = parser.parse_args()
    torch.set_num_threads(1)
    chosen = chosen_scenes(args)
    if not chosen:
        parser.error("there is no such scene")
    for name, settings in chosen.items():
        for method in args.methods:
            if settings.is_pac_nerf(method):
                fields = args.fields or Path(settings.results_root)
                print(judge_pac_nerf(name, settings, method, fields), flush=True)
            elif settings.is_springs(method):
                print(judge(name, settings, method), flush=True)
            else:
                parser.error(f"{method} is none of another system")


if __name__ == "__main__":
    main()
