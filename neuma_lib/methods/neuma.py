"""NeuMA (paper Sec. 3): the networks of a prior and a low-rank correction, trained on pixels."""

from neuma_lib.config.motion import WithPrior
from neuma_lib.config.training import TrainingConfig
from neuma_lib.methods.base import AS_IDENTIFIED, Case, Files, Method, Preset, training_inputs


class NeumaOptions(TrainingConfig, WithPrior):
    """Options of NeuMA: its training, and the prior that it starts from."""


class Neuma(Method):
    name = "neuma"
    Options = NeumaOptions
    product = "adaptor.safetensors"
    presets = {
        "neuma": Preset("NeuMA"),
        "neuma_particle_supervision": Preset("NeuMA w/ P.S.", {"supervision": "particles", "lr_scale": 2}),
        "neuma_without_binding": Preset(
            "NeuMA w/o Bind",
            {"particle_source": "gaussians", "lr_scale": 2},
            note="Trained with the Gaussians as particles, as in the paper, but evaluated with its law on the volume "
            "particles that all rows share. The paper's experiment simulates the Gaussians in both.",
        ),
        "neuma_without_binding_own": Preset(
            "NeuMA w/o Bind, own particles",
            same_fit_as="neuma_without_binding",
            evaluate_on="training_particles",
            note="The paper's experiment: the law of w/o Bind on the particles that it was trained with, the "
            "Gaussians, which also carry the tracers.",
        ),
        "neuma_without_adaptor": Preset("NeuMA w/o ΔM", {"rank": None}),
        "neuma_same_inputs": Preset(
            "NeuMA, inputs of Constants",
            AS_IDENTIFIED,
            note="NeuMA with all that the row Constants has but its law: Gaussians that follow the total deformation "
            "and the affine motion of their particles, and the initial motion that the identification fitted. Both "
            "laws are fitted on the grid of the prediction, so that both compensate its error.",
        ),
    }

    def fit_inputs(self, case: Case) -> Files:
        return training_inputs(case) | {"prior": case.prior_file()}

    def model_inputs(self, case: Case) -> Files:
        return {"prior": case.prior_file(), "adaptor": case.product()}

    def seeds(self, case: Case) -> tuple[str, ...]:
        drawn = ("adaptor",) if case.options.rank is not None else ()
        return (*super().seeds(case), *drawn)

    def fit(self, inputs, options, problem, run):
        from neuma_lib.fitting.material import train_material
        from neuma_lib.io.laws import load_adaptable, save_adaptor
        from neuma_lib.methods.training import Training

        settings = NeumaOptions(**options)
        law = load_adaptable(inputs["prior"], problem.simulation["dt"]).to(run.device)
        law.attach_adaptor(settings.rank, settings.alpha, settings.seed)
        training = Training(inputs, options, settings, problem, run)
        trained = train_material(*training.problem(law), **training.options())
        training.write_history(trained)
        about = {"settings": options, "grid": problem.simulation["grid"], **training.report(trained)}
        save_adaptor(run.product, trained.law, settings.rank, settings.alpha, about)
        training.finish(trained)

    def load(self, inputs, options, dt):
        from neuma_lib.io.laws import load_law
        from neuma_lib.io.weights import read_weights
        from neuma_lib.methods.model import LawOnGrid

        stable = read_weights(inputs["adaptor"])[1]["stable"]
        return LawOnGrid(load_law(inputs.get("prior"), inputs["adaptor"], dt), stable=stable)
