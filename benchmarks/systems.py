"""Other systems judged against known truths: how far tracers are off, in what time. Here Spring-Gaus and its choices.

    python -m benchmarks.systems JellyDuck                                 # reads data/, results/, config/config.yaml
    python -m benchmarks.systems random1_04 --methods spring_gaus spring_gaus+truncated=true+iterations=10

A scene may be named by the beginning of its name. Dataset and reconstruction must exist (`snakemake
results/SCENE/velocity.json`). The truth is read here; nothing is fitted to it. Settings are to be tuned on draws that
are not reported.
"""

from __future__ import annotations

import resource
from pathlib import Path

import torch

from benchmarks.project_scenes import chosen_scenes, scene_parser, simulator
from neuma_lib.config.settings import Config
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.evaluation.springs import predict_springs
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.fitting.springs import fit_springs
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_body, thrown
from neuma_lib.springs.body import SpringBody
from neuma_lib.springs.network import Springs
from neuma_lib.springs.rollout import SpringModel

TRACERS = 2000  # of the truth's, for the motion


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
    start, density = thrown(body, results / "velocity.json"), float(body.mass.sum() / body.vol0.sum())
    network = (how.anchors, how.neighbours, how.hard_springs, how.exponent, how.carriers)
    model = SpringModel.of(simulator(settings, scene), how.substeps)
    before = _core_seconds()
    anchored = SpringBody.of(body.x0, *network)
    springs = Springs.of_modulus(anchored.network, how.guess, density, how.resistance, how.gap)
    loss = PixelLoss(body, video, material.covariance_gradient)
    fitted = fit_springs(model, anchored, springs, start, loss, material, how)
    seconds = _core_seconds() - before
    arrays, _ = read_arrays(data / "particles.h5", required=("tracers",), only=("tracers",))
    truth = torch.from_numpy(arrays["tracers"])
    truth = truth[:, :: max(1, truth.shape[1] // TRACERS)].to(body.x0)
    path, failure = predict_springs(model, anchored, springs, start, video.frames, truth[0], how.carriers)
    found = tracer_errors(path.tracers, truth)
    said = f"{found['tracer_rmse_mm']:.2f} mm, last frame {found['tracer_rmse_last_mm']:.2f} mm"
    said += f", {seconds:.0f} core s; {fitted.summary(density)}"
    return f"{name} {method}: {said}" + (f"; a particle {failure.happened}" if failure else "")


def _core_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = scene_parser(__doc__, nargs="+")
    parser.add_argument(
        "--methods", nargs="+", default=["spring_gaus"], help="methods or variants with springs"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    chosen = chosen_scenes(args)
    if not chosen:
        parser.error("there is no such scene")
    for name, settings in chosen.items():
        for method in args.methods:
            if not settings.is_springs(method):
                parser.error(f"{method} has no springs")
            print(judge(name, settings, method), flush=True)


if __name__ == "__main__":
    main()
