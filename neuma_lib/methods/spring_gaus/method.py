"""Spring-Gaus (Zhong et al., ECCV 2024): a network of springs in the body, without a material law."""

from neuma_lib.config.training import TrainingConfig
from neuma_lib.methods.base import BODY, Case, Files, Method, Preset
from neuma_lib.methods.spring_gaus.options import SpringsConfig

OF_NETWORK = ("anchors", "neighbours", "hard_springs", "exponent", "carriers")
"""Options that a network of springs is built with."""


class SpringGausOptions(TrainingConfig, SpringsConfig):
    """Options of the training and of the network."""


class SpringGaus(Method):
    name = "spring_gaus"
    Options = SpringGausOptions
    sections = ("training", "springs")
    product = "springs.safetensors"
    fit_kernels = ("springs", "rendering")
    kernels = ("springs",)
    has_law = False
    moves_other_bodies = False
    presets = {
        "spring_gaus": Preset(
            "Spring-Gaus",
            {"rank": None, "gaussian_motion": "affine", "iterations": 80},
            note="The spring-mass model of Spring-Gaus (ECCV 2024) on this project's reconstruction, start, images and "
            "measures; docs/systems.md lists what is as published and what is reduced.",
        )
    }

    def fit_inputs(self, case: Case) -> Files:
        return {
            **{name: case.result(file) for name, file in BODY.items()},
            "transforms": case.data("dynamic/transforms.json"),
            "velocity": self.start_file(case),
        }

    def model_inputs(self, case: Case) -> Files:
        return {"springs": case.product()}

    def model_options(self, case: Case) -> dict:
        plain = case.options.plain()
        return {name: plain[name] for name in OF_NETWORK}

    def fit(self, inputs, options, problem, run):
        from dataclasses import asdict

        import torch

        from neuma_lib.fitting.frame_batches import check_contact
        from neuma_lib.fitting.material import PixelLoss
        from neuma_lib.io.files import write_json
        from neuma_lib.io.images import load_videos
        from neuma_lib.io.particles import load_reconstruction, with_motion
        from neuma_lib.io.simulator import simulator
        from neuma_lib.methods.spring_gaus.body import SpringBody
        from neuma_lib.methods.spring_gaus.fit import fit_springs
        from neuma_lib.methods.spring_gaus.io import save_springs
        from neuma_lib.methods.spring_gaus.network import Springs
        from neuma_lib.methods.spring_gaus.rollout import SpringModel

        settings = SpringGausOptions(**options)
        files = (inputs[name] for name in ("particles", "binding", "gaussians"))
        body = load_reconstruction(*files, problem.densities[0], gaussian_motion=settings.gaussian_motion)
        body = body.to(torch.float32, run.device)
        videos = load_videos(inputs["transforms"], settings.views, **problem.exposure)
        videos = [video.to(torch.float32, run.device) for video in videos]
        start, density = with_motion(body, inputs["velocity"]), float(body.mass.sum() / body.vol0.sum())
        loss = PixelLoss(body, videos, settings.covariance_gradient, compare=settings.compare)
        check_contact(simulator(problem.simulation), [(start, loss.frames)])
        anchored = SpringBody.of(body.x0, *(getattr(settings, name) for name in OF_NETWORK))
        springs = Springs.of_modulus(
            anchored.network, settings.guess, density, settings.resistance, settings.gap
        )
        known = {
            "simulation": problem.simulation,
            "exposure": problem.exposure,
            "density": problem.densities[0],
        }
        checkpoint = run.checkpoint({**known, **options}, inputs)
        fitted = fit_springs(
            SpringModel.of(simulator(problem.simulation), settings.substeps),
            anchored,
            springs,
            start,
            loss,
            settings,
            settings,
            checkpoint=checkpoint,
            progress=run.progress,
            log=run.log,
        )
        curves = asdict(fitted.history)
        del curves["seconds"]  # equal settings give equal files
        report = {"best_loss": fitted.best_loss, "best_iteration": fitted.best_iteration}
        report |= {"stable": fitted.stable, "substeps": fitted.substeps}
        write_json(run.history, {**report, **curves})
        save_springs(
            run.product, anchored, fitted.springs, {"settings": options, "density": density, **report}
        )
        checkpoint.remove()
        run.log(fitted.summary(density))

    def load(self, inputs, options, dt):
        from neuma_lib.methods.spring_gaus.model import SpringMotion

        return SpringMotion(inputs["springs"], options)
