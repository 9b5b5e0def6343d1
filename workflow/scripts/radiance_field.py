"""Fit a voxel radiance field to the views at t = 0, and show held-out views next to the images."""

from dataclasses import asdict

import torch
from PIL import Image

from neuma_lib.device import choose_device
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.files import atomic, write_json
from neuma_lib.io.images import load_views
from neuma_lib.methods.pac_nerf.field_fit import fit_radiance_field
from neuma_lib.methods.pac_nerf.field_options import RadianceConfig
from neuma_lib.methods.pac_nerf.io import save_field
from neuma_lib.splatting.observation import over_white
from workflow.provenance import fingerprint
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings, device = RadianceConfig(**params.fit), choose_device(params.device)
    images, cameras = (part.to(device=device) for part in load_views(inputs.transforms))
    stamp = {**params.fit, "seed": params.seed}
    checkpoint = Checkpoint(
        params.checkpoint, fingerprint(stamp, {"transforms": inputs.transforms}, params.code)
    )
    field, report = fit_radiance_field(
        images,
        cameras,
        settings,
        seed=params.seed,
        checkpoint=checkpoint,
        progress=lambda iteration, loss: run.progress(iteration + 1, settings.iterations, loss),
    )
    particles = field.particles(settings.spacing, settings.min_opacity)
    pairs = [
        torch.cat([over_white(images[view]), field.draw(cameras, view, particles).clamp(0, 1)])
        for view in report.held_out
    ]
    with atomic(output.views) as partial:  # the images above, the field below
        picture = (torch.cat(pairs, dim=1) * 255).round().byte().cpu().numpy()
        Image.fromarray(picture).save(partial, "PNG")
    save_field(output.field, field, {"settings": params.fit, "seed": params.seed})
    write_json(output.report, asdict(report))
    checkpoint.remove()
    run.log(
        f"{report.particles} particles, voxel {1000 * report.voxel:.0f} mm, PSNR on held-out views"
        f" {report.psnr:.1f} dB, inside the object {report.psnr_object:.1f} dB"
        f" ({report.direct_psnr_object:.1f} dB without particles)"
    )


run_script(main, snakemake)
