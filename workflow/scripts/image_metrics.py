"""Compare a method's renders with the observation, in views that its training did not see if there are any."""

import numpy as np
import torch

from neuma_lib.coupling.filmed import Filmed
from neuma_lib.device import choose_device
from neuma_lib.errors import InputError
from neuma_lib.evaluation.image_metrics import MEASURES, image_metrics
from neuma_lib.evaluation.lpips import LPIPS
from neuma_lib.fitting.frame_batches import frame_batches
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_videos
from neuma_lib.io.particles import load_motion
from neuma_lib.io.weights import read_weights
from neuma_lib.splatting.observation import rendered_steps
from workflow.motion import Prediction
from workflow.stage import run_script


def measure_view(body, observation, steps, x, F, networks, margin) -> list[dict[str, float]]:
    """Measures of every frame of one view; x and F are states at the steps."""
    white = Filmed(body.particle_gs(observation.cameras), observation, steps)
    black = Filmed(body.particle_gs(observation.cameras, background=(0.0, 0.0, 0.0)), observation, steps)
    measures = []
    for part in frame_batches(len(observation.frames), white.batch):
        states = (white.states(x, part), white.states(F, part))
        images = white(*states)
        # What shows through over white and not over black is the background.
        alphas = 1 - (images - black(*states)).mean(-1)
        seen, masks = observation.colours(part), observation.images[part][..., 3].to(images) / 255
        for frame in zip(images[:, 0], alphas[:, 0], seen[:, 0], masks[:, 0], strict=True):
            measures.append(image_metrics(*frame, networks, margin))
    return measures


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    weights, _ = read_weights(inputs.weights)
    networks = {name: LPIPS(weights, name).to(device) for name in ("vgg", "alex")}
    prediction = Prediction(inputs, params.method)
    body = prediction.body(params.density, params.particle_source, params.gaussian_motion, device)
    arrays, _ = read_arrays(inputs.rollout, required=("frames",), only=("frames",))
    x, F = (state.to(device) for state in load_motion(inputs.rollout))
    steps, by_step = arrays["frames"].tolist(), {}
    for k, view in enumerate(params.views):
        for video in load_videos(inputs.transforms, [view], **params.exposure):
            if not set(rendered_steps([video])) <= set(steps):
                raise InputError(
                    f"{inputs.rollout} has other frames than {inputs.transforms}: run evaluation again"
                )
            with torch.no_grad():
                measures = measure_view(
                    body, video.to(torch.float32, device), steps, x, F, networks, params.margin
                )
            for step, measured in zip(video.frames, measures, strict=True):
                by_step.setdefault(step, []).append(measured)
        run.progress(k + 1, len(params.views), float(np.mean([m["psnr"] for m in measures])))
    frames = sorted(by_step)
    per_frame = {
        name: np.array([np.mean([m[name] for m in by_step[step]]) for step in frames]) for name in MEASURES
    }
    seen = sorted(set(params.views) & set(params.training_views))
    report = {"views": params.views, "views_seen_in_training": seen}
    report |= {"frames": frames, "margin": params.margin}
    report |= {name: float(values.mean()) for name, values in per_frame.items()}
    report |= {f"{name}_per_frame": values.tolist() for name, values in per_frame.items()}
    write_json(output.metrics, report)
    views = ", ".join(map(str, params.views)) + (" (SEEN IN TRAINING)" if seen else "")
    run.log(
        f"views {views}: PSNR {report['psnr']:.1f} dB, SSIM {report['ssim']:.3f},"
        f" LPIPS {report['lpips_vgg']:.3f} (VGG) {report['lpips_alex']:.3f} (Alex)"
    )


run_script(main, snakemake)
