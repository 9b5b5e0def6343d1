"""PAC-NeRF (Li et al., ICLR 2023): a radiance field, the initial velocity, and the constants of a given law."""

from neuma_lib.config.motion import MotionOptions
from neuma_lib.errors import InputError
from neuma_lib.methods.base import Case, Files, Method, Preset
from neuma_lib.methods.pac_nerf.options import PacNerfConfig

FIELD = "pac_nerf/field.safetensors"


class PacNerfOptions(MotionOptions, PacNerfConfig):
    """Options of the fit of velocity and constants."""


class PacNerf(Method):
    name = "pac_nerf"
    Options = PacNerfOptions
    sections = ("training", "pac_nerf")
    product = "constants.json"
    fit_kernels = ("laws", "radiance")
    body_kernels = ("radiance",)
    presets = {
        "pac_nerf": Preset(
            "PAC-NeRF",
            {"covariance_from": "total", "gaussian_motion": "affine", "views": [0, 1, 2]},
            note="PAC-NeRF (ICLR 2023) in the family of the scene's prior and in all three views, from the authors' "
            "initial constants unless the row names others. Its constants and its own velocity on the particles that "
            "all rows share. docs/systems.md lists what is as published and what is reduced.",
        ),
        "pac_nerf_own": Preset(
            "PAC-NeRF, own particles",
            same_fit_as="pac_nerf",
            evaluate_on="training_particles",
            note="PAC-NeRF's constants and velocity on the particles that it found them with, drawn from its radiance "
            "field, whose opacities weigh mass and stiffness; they also carry the tracers, and its pictures are of the "
            "field.",
        ),
    }

    def fit_inputs(self, case: Case) -> Files:
        return {
            "field": case.result(FIELD),
            "transforms": case.data("dynamic/transforms.json"),
            "velocity": case.result("velocity.json"),
        }

    def fit_options(self, case: Case) -> dict:
        return {"prior": case.prior_law, "radiance": _seen(case), **super().fit_options(case)}

    def model_inputs(self, case: Case) -> Files:
        return {"constants": case.product()}

    def body_inputs(self, case: Case) -> Files:
        return {"field": case.on_moved().result(FIELD)} if self.particle_source(case) == "field" else {}

    def model_options(self, case: Case) -> dict:
        if self.particle_source(case) != "field":
            return {}
        settings = {name: case.options.plain()[name] for name in PacNerfConfig.model_fields}
        return {**_seen(case), "settings": settings}

    def start_file(self, case: Case) -> str:
        return case.on_moved().product()

    def particle_source(self, case: Case) -> str:
        return "field" if case.evaluate_on == "training_particles" else "binding"

    def fit(self, inputs, options, problem, run):
        from dataclasses import asdict

        import torch

        from neuma_lib.io.files import read_json, write_json
        from neuma_lib.io.images import load_videos
        from neuma_lib.io.simulator import simulator
        from neuma_lib.methods.pac_nerf.carried_field import CarriedField
        from neuma_lib.methods.pac_nerf.families import choose_family
        from neuma_lib.methods.pac_nerf.fit import fit_pac_nerf
        from neuma_lib.methods.pac_nerf.io import load_field

        options = dict(options)
        prior, radiance = options.pop("prior"), options.pop("radiance")
        settings, density = PacNerfOptions(**options), problem.densities[0]
        family, constants = choose_family(settings, prior)
        guess = constants.specification()
        run.log(f"family {family}, from {settings.guesses} guesses: {guess}")
        field, _ = load_field(inputs["field"])
        body = CarriedField(field.to(run.device), **radiance, settings=settings, density=density)
        estimated = read_json(inputs["velocity"])
        if not estimated.get("frames"):
            raise InputError(
                inputs["velocity"], "it names no frames before contact", "Run the rule velocity again"
            )
        known = {"simulation": problem.simulation, "density": density, "seed": problem.seed}
        checkpoint = run.checkpoint({**known, "radiance": radiance, "guess": guess, **options}, inputs)
        video, *others = load_videos(inputs["transforms"], settings.views, **problem.exposure)
        if others or video.exposure != (0,):
            raise InputError(
                inputs["transforms"],
                "PAC-NeRF compares images that all its views took at the same instants, and the views "
                f"{list(settings.views)} differ in steps, size or exposure, or have an exposure",
                "Choose one view by +views=0, and ignore motion blur by dataset.exposure_samples: 1",
            )
        fit = fit_pac_nerf(
            simulator(problem.simulation),
            body,
            video.to(torch.float32, run.device),
            estimated["frames"][-1],
            constants,
            settings,
            problem.seed,
            checkpoint=checkpoint,
            progress=run.progress,
            log=run.log,
        )
        curves = asdict(fit.history)
        del curves["seconds"]  # equal settings give equal files
        centre = body.mass @ body.moving.x / body.mass.sum()
        start = {"v0": fit.velocity.tolist(), "angular_velocity": [0.0, 0.0, 0.0], "centre": centre.tolist()}
        about = {"family": family, "law": constants.specification(), "guess": guess}
        about |= {"guesses": settings.guesses, "fitted": constants.fitted}
        write_json(run.product, {**about, "start": start})
        write_json(run.history, {**curves, "velocity_loss": fit.velocity_losses})
        checkpoint.remove()
        run.log(fit.summary())

    def load(self, inputs, options, dt):
        from neuma_lib.io.files import read_json
        from neuma_lib.mechanics.analytic import analytic_law
        from neuma_lib.methods.model import LawOnGrid

        return LawOnGrid(analytic_law(read_json(inputs["constants"])["law"], dt=dt))

    def load_initial_state(self, inputs, options, densities, particle_source):
        if particle_source != "field":
            return super().load_initial_state(inputs, options, densities, particle_source)
        from neuma_lib.io.particles import with_motion

        body = self.load_reconstruction(inputs, options, densities[0], particle_source, "mean")
        return with_motion(body, inputs["velocity"]), [len(body.moving.x)]

    def load_reconstruction(self, inputs, options, density, particle_source, gaussian_motion, device="cpu"):
        if particle_source != "field":
            return super().load_reconstruction(
                inputs, options, density, particle_source, gaussian_motion, device
            )
        from neuma_lib.methods.pac_nerf.carried_field import CarriedField

        return CarriedField.load(inputs["field"], options, density, device)


def _seen(case: Case) -> dict:
    """Options that select the visible particles of the field."""
    section = case.section("radiance")
    return {name: section[name] for name in ("spacing", "min_opacity")}
