"""An analytic law and a correction by small networks that keep the structure of a material."""

from collections.abc import Iterator

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
    training_inputs,
)
from neuma_lib.methods.constants import Constants

IDENTIFIED = "identified"


class StructuredOptions(TrainingConfig, StructuredConfig, WithPrior):
    """Options of the training, of the correction, and the prior whose analytic law is corrected."""


class Structured(Method):
    name = "structured"
    Options = StructuredOptions
    sections = ("training", "structured")
    product = "adaptor.safetensors"
    fits_together = True
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
        if case.bodies:
            if case.prior != IDENTIFIED:
                raise InputError(
                    f"{case.name} on {case.scene}",
                    f"the prior {case.prior} is the law of one body",
                    f"Use +prior={IDENTIFIED}",
                )
            files = {
                name: [each.result(file) for each in case.bodies.values()] for name, file in BODY.items()
            }
            video = {"transforms": case.data("dynamic/transforms.json")}
            identified = case.result("identified.json")
            return {**files, **video, "velocity": identified, "identified": identified}
        base = {"identified": case.result(case.identified())} if case.prior == IDENTIFIED else {}
        return training_inputs(case) | base

    def fit_options(self, case: Case) -> dict:
        return {"base": self._base(case), **super().fit_options(case)}

    def model_inputs(self, case: Case) -> Files:
        if case.together:
            return {"adaptor": case.together[0].product(), **Constants().model_inputs(case)}
        return {"adaptor": case.product()}

    def model_options(self, case: Case) -> dict:
        return Constants().model_options(case) if case.prior == IDENTIFIED else {}

    def seeds(self, case: Case) -> tuple[str, ...]:
        return (*super().seeds(case), "adaptor")  # of the first layers

    def fit(self, inputs, options, problem, run):
        from neuma_lib.fitting.families import FRICTION
        from neuma_lib.fitting.identified import recorded_friction
        from neuma_lib.fitting.structured_fit import Alternative, rival_bases, train_structured
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
        identified = {} if base else read_json(inputs["identified"])
        names = list(identified.get("bodies", ()))
        pairs = tuple(
            Pair(*sorted(map(names.index, pair["bodies"])), pair["friction"])
            for pair in identified.get("pairs", ())
        )
        friction = recorded_friction(identified)
        training = Training(inputs, options, settings, problem, run, {"base": base}, friction, pairs)
        dt = problem.simulation["dt"]
        others = {
            name: analytic_law(identified["bodies"][name]["law"], dt=dt).to(run.device) for name in names
        }

        def laws_of(name: str) -> Iterator[Alternative]:
            """The law of a body and its rivals."""
            own = identified["bodies"][name] if name else identified
            bases = [base] if base else [own["law"], *rival_bases(own, settings.rivals)]

            def surrounded(law):
                return consecutive([*(others | {name: law}).values()], training.counts) if name else law

            for k, each in enumerate(bases):
                law = structured_law({**each, "form": settings.form}, dt, seed=settings.seed).to(run.device)
                law.attach_adaptor(settings.rank, settings.alpha, settings.seed)
                title = ", ".join(filter(None, [name, f"rival {k}" if k else ""]))
                yield Alternative(law, title, surrounded, rival=k > 0)

        alternatives = [(name, each) for name in names or [""] for each in laws_of(name)]
        first, *rest = (each for _, each in alternatives)
        trained, chosen = train_structured(
            *training.problem(first.law),
            settings,
            alternatives=rest,
            surrounded=first.surrounded,
            name=first.name,
            **training.options(),
        )
        run.log(chosen.summary())
        training.write_history(trained, chosen.as_dict())
        about = {"settings": options, "grid": problem.simulation["grid"], **training.report(trained)}
        about |= {FRICTION: identified[FRICTION]} if friction is not None else {}
        about |= {"body": alternatives[chosen.base][0]} if names else {}
        save_adaptor(run.product, trained.law, settings.rank, settings.alpha, about)
        training.finish(trained)

    def load(self, inputs, options, dt):
        from neuma_lib.fitting.identified import recorded_friction
        from neuma_lib.io.laws import load_law
        from neuma_lib.io.weights import read_weights
        from neuma_lib.methods.model import LawOnGrid

        about = read_weights(inputs["adaptor"])[1]
        if options.get("body") is not None:
            identified = Constants().load(inputs, options, dt)
            if options["body"] != about["body"]:
                return identified
            options = {**options, "pairs": identified.pairs}
        law, friction = load_law(None, inputs["adaptor"], dt), recorded_friction(about)
        return LawOnGrid(law, stable=about["stable"], friction=friction, **options)

    def uncertainty_inputs(self, case: Case) -> Files:
        if case.prior != IDENTIFIED or case.together:
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
