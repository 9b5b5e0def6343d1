"""An analytic law and a correction by small networks that keep the structure of a material."""

from neuma_lib.config.motion import WithPrior
from neuma_lib.config.structured import StructuredConfig
from neuma_lib.config.training import TrainingConfig
from neuma_lib.errors import InputError
from neuma_lib.methods.base import (
    AS_IDENTIFIED,
    BODY,
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
        if case.options.corrected is not None:
            whole, bodies = self._corrected(case)
            if bodies[case.options.corrected].scene != case.scene:
                raise InputError(
                    f"{case.name} on {case.scene}", "another body is corrected", "Take its scene"
                )
            identified = whole.result("identified.json")
            files = {name: [each.result(file) for each in bodies.values()] for name, file in BODY.items()}
            video = {"transforms": whole.data("dynamic/transforms.json")}
            return {**files, **video, "velocity": identified, "identified": identified}
        base = {"identified": case.result(case.identified())} if case.prior == IDENTIFIED else {}
        return training_inputs(case) | base

    def fit_options(self, case: Case) -> dict:
        return {"base": self._base(case), **super().fit_options(case)}

    def model_inputs(self, case: Case) -> Files:
        if case.options.corrected is not None:
            whole, bodies = self._corrected(case)
            adaptor = bodies[case.options.corrected].product()
            return {"adaptor": adaptor, "identified": whole.result("identified.json")}
        return {"adaptor": case.product()}

    def model_options(self, case: Case) -> dict:
        if case.options.corrected is not None:
            body = case.together[1] if case.together else case.options.corrected
            return {"body": body, "corrected": case.options.corrected}
        return friction_options(case) if case.prior == IDENTIFIED else {}

    def seeds(self, case: Case) -> tuple[str, ...]:
        return (*super().seeds(case), "adaptor")  # of the first layers

    def fit(self, inputs, options, problem, run):
        from neuma_lib.fitting.families import FRICTION
        from neuma_lib.fitting.identified import recorded_friction
        from neuma_lib.fitting.structured_fit import rival_bases, train_structured
        from neuma_lib.io.files import read_json
        from neuma_lib.io.laws import save_adaptor
        from neuma_lib.mechanics.analytic import analytic_law
        from neuma_lib.mechanics.structured import structured_law
        from neuma_lib.methods.training import Training
        from neuma_lib.sim.bodies import Pair
        from neuma_lib.sim.model import consecutive

        options = dict(options)
        base = options.pop("base")
        settings = StructuredOptions(**options)
        bases, identified, together = [base], {}, {}
        if not base:
            identified = read_json(inputs["identified"])
            if settings.corrected is not None:
                together, identified = identified, identified["bodies"][settings.corrected]
            bases = [identified["law"], *rival_bases(identified, settings.rivals)]
        laws = [
            structured_law({**each, "form": settings.form}, problem.simulation["dt"], seed=settings.seed)
            for each in bases
        ]
        laws = [law.to(run.device) for law in laws]
        for law in laws:
            law.attach_adaptor(settings.rank, settings.alpha, settings.seed)
        friction = recorded_friction(identified)
        names = list(together.get("bodies", ()))
        pairs = tuple(
            Pair(*sorted(map(names.index, pair["bodies"])), pair["friction"])
            for pair in together.get("pairs", ())
        )
        training = Training(inputs, options, settings, problem, run, {"base": base}, friction, pairs)
        others = {
            name: analytic_law(together["bodies"][name]["law"], problem.simulation["dt"]).to(run.device)
            for name in names
        }

        def surrounded(law):
            if not together:
                return law
            return consecutive([*(others | {settings.corrected: law}).values()], training.counts)

        trained, chosen = train_structured(
            *training.problem(laws[0]),
            settings,
            rivals=laws[1:],
            surrounded=surrounded,
            **training.options(),
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
        from neuma_lib.methods.constants import Constants
        from neuma_lib.methods.model import LawOnGrid

        corrected = options.get("corrected")
        options = {key: value for key, value in options.items() if key != "corrected"}
        if corrected is not None:
            identified = Constants().load(inputs, options, dt)
            if options["body"] != corrected:
                return identified
            options["pairs"] = identified.pairs
        about = read_weights(inputs["adaptor"])[1]
        law, friction = load_law(None, inputs["adaptor"], dt), recorded_friction(about)
        return LawOnGrid(law, stable=about["stable"], friction=friction, **options)

    def uncertainty_inputs(self, case: Case) -> Files:
        if case.prior != IDENTIFIED or case.options.corrected is not None:
            return {}
        return {"identified": case.result(case.identified()), "rollout": case.rollout()}

    @staticmethod
    def _corrected(case: Case) -> tuple[Case, dict[str, Case]]:
        """`Case.with_others` with the corrected body. Raises InputError if it is none of them."""
        whole, bodies = case.with_others()
        if case.prior != IDENTIFIED or case.options.corrected not in bodies:
            problem = f"corrected = {case.options.corrected} with the prior {case.prior}"
            remedy = f"Give one of {', '.join(bodies)}, and the prior {IDENTIFIED}"
            raise InputError(f"{case.name} on {case.scene}", problem, remedy)
        return whole, bodies

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
