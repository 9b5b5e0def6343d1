"""Fit static Gaussian kernels to the views at t = 0."""

from dataclasses import asdict

from neuma_lib.config.gaussians import GaussiansConfig
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.device import choose_device
from neuma_lib.fitting.gaussians import fit_gaussians
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
    save_gaussians(output.gaussians, gaussians)
    write_json(output.report, {key: value for key, value in asdict(report).items() if value is not None})
    run.log(
        f"{report.count} Gaussians ({report.culled} culled), PSNR on held-out views {report.psnr:.1f} dB,"
        f" inside the object {report.psnr_object:.1f} dB"
        + (", after the exposure of each was fitted" if report.gains else "")
    )


run_script(main, snakemake)
