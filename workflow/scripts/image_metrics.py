"""Compare a method's renders with the observation, in views that its training did not see if there are any."""

import numpy as np
import torch

from neuma_lib.device import choose_device
from neuma_lib.errors import InputError
from neuma_lib.evaluation.image_metrics import MEASURES, image_metrics
from neuma_lib.evaluation.lpips import LPIPS
from neuma_lib.fitting.carried_field import CarriedField
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_body, load_motion
from neuma_lib.io.weights import read_weights
from workflow.stage import run_script


def measure_view(body, observation, x, F, networks, margin) -> list[dict[str, float]]:
    """Measures of every frame of one view."""
    white = body.particle_gs(observation.cameras)
    black = body.particle_gs(observation.cameras, background=(0.0, 0.0, 0.0))
    found = []
    for part, images in white.batches(x, F, size=white.frames_per_batch):
        # What shows through over white and not over black is the background.
        alphas = 1 - (images - black(x[part], F[part])).mean(-1)
        seen, masks = observation.colours(part), observation.images[part][..., 3].to(images) / 255
        for frame in zip(images[:, 0], alphas[:, 0], seen[:, 0], masks[:, 0], strict=True):
            found.append(image_metrics(*frame, networks, margin))
    return found


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    weights, _ = read_weights(inputs.weights)
    networks = {name: LPIPS(weights, name).to(device) for name in ("vgg", "alex")}
    if params.own:
        body = CarriedField.load(inputs.field, params.own, params.density, device)
    else:
        files = (inputs.particles, inputs.binding, inputs.gaussians)
        body = load_body(*files, params.density, params.carrier, params.gaussian_motion)
        body = body.to(torch.float32, device)
    arrays, _ = read_arrays(inputs.rollout, required=("frames",), only=("frames",))
    x, F = (state.to(device) for state in load_motion(inputs.rollout))
    table = []
    for k, view in enumerate(params.views):
        observation = load_observation(inputs.transforms, [view]).to(torch.float32, device)
        if list(observation.frames) != arrays["frames"].tolist():
            raise InputError(
                f"{inputs.rollout} has other frames than {inputs.transforms}: run evaluation again"
            )
        with torch.no_grad():
            table.append(measure_view(body, observation, x, F, networks, params.margin))
        run.progress(k + 1, len(params.views), float(np.mean([m["psnr"] for m in table[-1]])))
    per_frame = {name: np.mean([[m[name] for m in frames] for frames in table], axis=0) for name in MEASURES}
    seen = sorted(set(params.views) & set(params.training_views))
    report = {"views": params.views, "views_seen_in_training": seen}
    report |= {"frames": arrays["frames"].tolist(), "margin": params.margin}
    report |= {name: float(values.mean()) for name, values in per_frame.items()}
    report |= {f"{name}_per_frame": values.tolist() for name, values in per_frame.items()}
    write_json(output.metrics, report)
    views = ", ".join(map(str, params.views)) + (" (SEEN IN TRAINING)" if seen else "")
    run.say(
        f"views {views}: PSNR {report['psnr']:.1f} dB, SSIM {report['ssim']:.3f},"
        f" LPIPS {report['lpips_vgg']:.3f} (VGG) {report['lpips_alex']:.3f} (Alex)"
    )


run_script(main, snakemake)
