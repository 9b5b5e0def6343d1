"""Fit static Gaussian kernels to the views at t = 0."""

from dataclasses import asdict
from pathlib import Path

import numpy as np

from neuma_lib.capture.gates import check_fit, check_on_floor, draw_body
from neuma_lib.capture.pictures import evidence, picture_sheet
from neuma_lib.config.gaussians import GaussiansConfig
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.device import choose_device
from neuma_lib.fitting.gaussians import fit_gaussians, render_over_white
from neuma_lib.io.files import write_json
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.photographs import load_static
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    views = load_static(inputs.transforms, PhotographsConfig(**params.photographs)).to(device)
    if views.left_out:
        run.log(f"left out, since their masks lack a part of the body: {', '.join(views.left_out)}")
    settings = GaussiansConfig(**params.fit)
    gaussians, report = fit_gaussians(
        views.images,
        views.cameras,
        settings,
        seed=params.seed,
        progress=lambda iteration, loss: run.progress(iteration + 1, settings.iterations, loss),
        floor=views.floor,
        gain_rate=views.photographs.gain_rate if views.photographs else 0.0,
    )
    if photographs := views.photographs:
        means, name = gaussians.means.detach().cpu().numpy(), str(Path(inputs.transforms).parent.parent.name)

        def draw(path: Path) -> None:
            draw_comparison(
                path, gaussians, views, report.held_out or [0], f"{name}: photographs, and Gaussians"
            )

        with evidence(output.gaussians, draw):
            if report.held_out:
                check_fit(report.psnr_object, photographs.min_psnr, name)
        with evidence(
            output.gaussians, lambda path: draw_body(path, {"Gaussians": means}, views.floor, name)
        ):
            if views.floor is not None:
                check_on_floor(means, views.floor, name)
    save_gaussians(output.gaussians, gaussians)
    write_json(output.report, {key: value for key, value in asdict(report).items() if value is not None})
    run.log(
        f"{report.count} Gaussians ({report.culled} culled), PSNR on held-out views {report.psnr:.1f} dB,"
        f" inside the object {report.psnr_object:.1f} dB"
        + (", after the exposure of each was fitted" if report.gains else "")
    )


def draw_comparison(path, gaussians, views, chosen, title) -> None:
    """Draw photographs next to the Gaussians as seen by their cameras, over white."""
    sheet = []
    for k in chosen[:12]:
        rgba = views.images[k]
        seen = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
        rendered, _ = render_over_white(gaussians, gaussians.sh(), views.cameras[k])
        pair = np.concatenate([picture.detach().cpu().numpy() for picture in (seen, rendered)], axis=1)
        sheet.append((f"photograph {k}: seen, rendered", np.rint(255 * pair.clip(0, 1)).astype(np.uint8)))
    picture_sheet(path, sheet, title, 4)


run_script(main, snakemake)
