"""Compare a prediction with the video of a camera: measures of frames, and a video of both."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from neuma_lib.capture.pictures import read_picture
from neuma_lib.capture.report.images import (
    as_planes,
    averaged,
    captured_metrics,
    composited,
    error_picture,
    exposed,
)
from neuma_lib.coupling.filmed import Filmed
from neuma_lib.device import choose_device
from neuma_lib.errors import InputError
from neuma_lib.evaluation.lpips import LPIPS
from neuma_lib.evaluation.video import side_by_side, write_mp4
from neuma_lib.fitting.frame_batches import frame_batches, spread_frames
from neuma_lib.io.files import atomic, write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import filmed_steps, load_videos, read_transforms
from neuma_lib.io.particles import load_motion, load_reconstruction
from neuma_lib.io.weights import read_weights
from workflow.stage import run_script


class Layers(NamedTuple):
    """A renderer of colours with opacity for `Filmed`."""

    render: Callable
    frames_per_batch: int

    def __call__(self, x, F):
        return self.render(x, F)


class Prediction:
    """Renders of a rollout in a camera."""

    def __init__(self, body, rollout, needed):
        self.body = body
        arrays, _ = read_arrays(rollout, required=("frames",), only=("frames",))
        self.steps = arrays["frames"].tolist()
        if not set(needed) <= set(self.steps):
            raise InputError(rollout, "its steps are not those of the video", "Run the rule predict again")
        self.x, self.F = (state.to(body.x0) for state in load_motion(rollout))

    def frames(self, video):
        """Layer (H, W, 4) of each frame of a video of one camera: premultiplied colours and opacity."""
        renderer = self.body.particle_gs(video.cameras, background=(0.0, 0.0, 0.0))
        layers = Filmed(Layers(renderer.layer, renderer.frames_per_batch), video, self.steps)
        x, F = layers.states(self.x), layers.states(self.F)
        for part in frame_batches(len(video.frames), layers.batch):
            yield from layers(x[part], F[part])[:, 0]


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    weights, _ = read_weights(inputs.weights)
    networks = {name: LPIPS(weights, name).to(device) for name in ("vgg", "alex")}
    needed = filmed_steps(inputs.display, [params.view], **params.exposure)
    predictions = []
    for rollout, motion in [(inputs.rollout, params.gaussian_motion), (inputs.prior, params.prior_motion)]:
        if rollout:
            particle_source = params.particle_source if rollout == inputs.rollout else "binding"
            files = (inputs.particles, inputs.binding, inputs.gaussians)
            body = load_reconstruction(*files, params.density, particle_source, motion).to(
                torch.float32, device
            )
            predictions.append(Prediction(body, rollout, needed))
    folder = Path(inputs.display).parent
    entries = {f["step"]: f for f in read_transforms(inputs.display)["frames"] if f["view"] == params.view}
    background = read_picture(folder / next(iter(entries.values()))["plate"])
    steps = sorted(entries)
    measured = {steps[k] for k in spread_frames(len(steps), params.measured)}
    measures, panels = [], []
    for video in load_videos(inputs.display, [params.view], **params.exposure):
        video = video.to(torch.float32, device)
        with torch.no_grad():
            renders = zip(*(prediction.frames(video) for prediction in predictions), strict=True)
            for k, (step, rendered) in enumerate(zip(video.frames, renders, strict=True)):
                entry = entries[step]
                filmed = as_planes(read_picture(folder / entry["picture"])).to(device)
                empty = exposed(background, entry["plate_gain"], entry["plate_offset"])
                empty = torch.from_numpy(empty).float().to(device)
                gain = torch.tensor(entry["gain"], dtype=torch.float32, device=device)
                layers = [(gain * layer[..., :3], layer[..., 3]) for layer in rendered]
                pictures = [composited(*layer, empty) for layer in layers]
                if step in measured:
                    matte = as_planes(video.images[k, 0].cpu().numpy()).to(device)
                    values = captured_metrics(*layers[0], matte, filmed, empty, networks, params.margin)
                    measures.append({"step": step} | values)
                panel = [picture.clamp(0, 1).cpu().numpy() for picture in (filmed, *pictures)]
                panels.append((step, [*panel[:2], error_picture(*panel[:2]), *panel[2:]]))
                run.progress(len(panels), len(entries))
    panels.sort(key=lambda frame: frame[0])
    columns = [np.stack(panel) for panel in zip(*(frame for _, frame in panels), strict=True)]
    labels = ["video", params.title, "difference", "prior"][: len(columns)]
    rows = [slice(0, 2), slice(2, 4)] if len(columns) == 4 else [slice(0, 3)]
    film = np.concatenate([side_by_side(columns[row], labels[row]) for row in rows], axis=1)
    with atomic(output.video) as partial:
        write_mp4(partial, film, params.frame_rate, quality=24)
    mean = averaged([{k: v for k, v in frame.items() if k != "step"} for frame in measures])
    measures.sort(key=lambda frame: frame["step"])
    write_json(output.measures, {"frames": measures, "mean": mean})
    run.log(
        f"{len(panels)} frames, {len(measures)} measured. Object: PSNR {mean['psnr']:.1f} dB, SSIM {mean['ssim']:.3f},"
        f" LPIPS {mean['lpips_vgg']:.3f}, IoU {mean['iou']:.2f}. Whole picture: PSNR {mean['scene_psnr']:.1f} dB"
    )


run_script(main, snakemake)
