"""Fit static Gaussian kernels to the views at t = 0."""

from dataclasses import asdict

from neuma_lib.config.gaussians import GaussiansConfig
from neuma_lib.device import choose_device
from neuma_lib.fitting.gaussians import fit_gaussians
from neuma_lib.io.files import write_json
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.images import load_views
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    images, cameras = load_views(inputs.transforms)
    settings = GaussiansConfig(**params.fit)
    gaussians, report = fit_gaussians(
        images.to(device),
        cameras.to(device=device),
        settings,
        seed=params.seed,
        progress=lambda iteration, loss: run.progress(iteration + 1, settings.iterations, loss),
    )
    save_gaussians(output.gaussians, gaussians)
    write_json(output.report, asdict(report))
    run.say(
        f"{report.count} Gaussians ({report.culled} culled), PSNR on held-out views {report.psnr:.1f} dB,"
        f" inside the object {report.psnr_object:.1f} dB"
    )


run_script(main, snakemake)
