"""Film the prediction beside the observation."""

import torch

from neuma_lib.artifacts import load_body, load_observation
from neuma_lib.evaluation.metrics import psnr
from neuma_lib.evaluation.video import side_by_side, write_mp4
from neuma_lib.io import atomic, read_arrays
from neuma_lib.progress import stage


def main(inputs, video_file: str, params, run) -> None:
    observation = load_observation(inputs.transforms, [params.view])
    body = load_body(inputs.binding, inputs.gaussians, params.density)
    arrays, _ = read_arrays(inputs.rollout, required=("x", "F"))
    x, F = torch.from_numpy(arrays["x"]), torch.from_numpy(arrays["F"])
    renderer = body.particle_gs(observation.cameras)
    with torch.no_grad():
        frames = [images[:, 0] for _, images in renderer.batches(x, F, size=8)]
    predicted, seen = torch.cat(frames), observation.images[:, 0]
    video = side_by_side(
        [seen.numpy(), predicted.numpy()], ["observation", "prediction"], magnify=params.magnify
    )
    with atomic(video_file) as partial:
        write_mp4(partial, video, params.frame_rate)
    quality = [float(psnr(p, s)) for p, s in zip(predicted, seen, strict=True)]
    run.say(f"{len(video)} frames, PSNR {sum(quality) / len(quality):.1f} dB on average")


if __name__ == "__main__":
    with stage(f"video {snakemake.wildcards.scene}/{snakemake.wildcards.method}", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.video, snakemake.params, run)
