"""An analytic law and a correction by small networks that keep the structure of a material."""

from neuma_lib.config.motion import WithPrior
from neuma_lib.config.structured import StructuredConfig
from neuma_lib.config.training import TrainingConfig
from neuma_lib.errors import InputError
from neuma_lib.methods.base import (
    AS_IDENTIFIED,
    Case,
    Files,
    Method,
    Preset,
    friction_options,
    training_inputs,
)

IDENTIFIED = "identified"


class StructuredOptions(TrainingConfig, StructuredConfig, WithPrior):
    """Options of the training, of the correction, and the prior whose analytic law is corrected."""


class Structured(Method):
    name = "structured"
    Options = StructuredOptions
    sections = ("training", "structured")
    product = "adaptor.safetensors"
    draws_module = "neuma_lib.methods.draws"
    presets = {
        "neuma_structured": Preset(
            "NeuMA, structured",
            {
                "prior": IDENTIFIED,
                "rank": None,
                **AS_IDENTIFIED,
                "iterations": 16,
                "lr_elastic": 0.02,
                "lr_plastic": 0.04,
            },
            note="The law and the initial motion of the row Constants, corrected by small networks that keep the law "
            "isotropic and its stress symmetric and zero at rest. A part without gain on held-out frames stays "
            "unchanged.",
        )
    }

    def fit_inputs(self, case: Case) -> Files:
        base = {"identified": case.result(case.identified())} if case.prior == IDENTIFIED else {}
        return training_inputs(case) | base

    def fit_options(self, case: Case) -> dict:
        return {"base": self._base(case), **super().fit_options(case)}

    def model_inputs(self, case: Case) -> Files:
        return {"adaptor": case.product()}

    def model_options(self, case: Case) -> dict:
        return friction_options(case) if case.prior == IDENTIFIED else {}

    def seeds(self, case: Case) -> tuple[str, ...]:
        return (*super().seeds(case), "adaptor")  # of the first layers

    def fit(self, inputs, options, problem, run):
        from neuma_lib.fitting.families import FRICTION
        from neuma_lib.fitting.identified import recorded_friction
        from neuma_lib.fitting.structured_fit import rival_bases, train_structured
        from neuma_lib.io.files import read_json
        from neuma_lib.io.laws import save_adaptor
        from neuma_lib.mechanics.structured import structured_law
        from neuma_lib.methods.training import Training

        options = dict(options)
        base = options.pop("base")
        settings = StructuredOptions(**options)
        bases, identified = [base], {}
        if not base:
            identified = read_json(inputs["identified"])
            bases = [identified["law"], *rival_bases(identified, settings.rivals)]
        laws = [
            structured_law({**each, "form": settings.form}, problem.simulation["dt"], seed=settings.seed)
            for each in bases
        ]
        laws = [law.to(run.device) for law in laws]
        for law in laws:
            law.attach_adaptor(settings.rank, settings.alpha, settings.seed)
        friction = recorded_friction(identified)
        training = Training(inputs, options, settings, problem, run, {"base": base}, friction)
        trained, chosen = train_structured(
            *training.problem(laws[0]), settings, rivals=laws[1:], **training.options()
        )
        run.log(chosen.summary())
        training.write_history(trained, chosen.as_dict())
        about = {"settings": options, "grid": problem.simulation["grid"], **training.report(trained)}
        about |= {FRICTION: identified[FRICTION]} if friction is not None else {}
        save_adaptor(run.product, trained.law, settings.rank, settings.alpha, about)
        training.finish(trained)

    def load(self, inputs, options, dt):
        from neuma_lib.fitting.identified import recorded_friction
        from neuma_lib.io.laws import load_law
        from neuma_lib.io.weights import read_weights
        from neuma_lib.methods.model import LawOnGrid

        about = read_weights(inputs["adaptor"])[1]
        law, friction = load_law(None, inputs["adaptor"], dt), recorded_friction(about)
        return LawOnGrid(law, stable=about["stable"], friction=friction, **options)

    def uncertainty_inputs(self, case: Case) -> Files:
        if case.prior != IDENTIFIED:
            return {}
        return {"identified": case.result(case.identified()), "rollout": case.rollout()}

    def _base(self, case: Case) -> dict | None:
        """The analytic law of the prior, or None for the law identified in the video."""
        if case.prior == IDENTIFIED:
            return None
        if case.prior_law is None:
            raise InputError(
                f"{case.name} on {case.scene}",
                f"the prior {case.prior} is a file, and only an analytic law can be corrected",
                f"Use +prior={IDENTIFIED} or one of priors.laws, or the method neuma",
            )
        return case.prior_law
