"""The analytic law whose family and constants the stage `identify` fits to the video."""

from neuma_lib.methods.base import AS_IDENTIFIED, Case, Files, Method, Preset, friction_options


class Constants(Method):
    name = "constants"
    draws_module = "neuma_lib.methods.draws"
    presets = {
        "constants": Preset(
            "Constants",
            AS_IDENTIFIED,
            note="The analytic law whose family and few constants fit the training video best, launched with the "
            "initial motion of the same fit. Nothing else is learned.",
        )
    }

    def model_inputs(self, case: Case) -> Files:
        if case.together:
            return {"identified": case.together[0].result("identified.json")}
        return {"identified": case.result(case.identified())}

    def model_options(self, case: Case) -> dict:
        return friction_options(case) | ({"body": case.together[1]} if case.together else {})

    def load(self, inputs, options, dt):
        from neuma_lib.fitting.identified import recorded_friction
        from neuma_lib.io.files import read_json
        from neuma_lib.mechanics.analytic import analytic_law
        from neuma_lib.methods.model import LawOnGrid

        identified, body = read_json(inputs["identified"]), options.get("body")
        options = {key: value for key, value in options.items() if key != "body"}
        if body is not None:
            options["body"] = body
            options["pairs"] = {frozenset(pair["bodies"]): pair["friction"] for pair in identified["pairs"]}
            identified = identified["bodies"][body]
        law, material = analytic_law(identified["law"], dt=dt), None
        if "material" in identified:
            law.grid = identified.get("grid")
            material = analytic_law(identified["material"]["law"], dt=dt)
        known = identified.get("material") or identified.get("best") or {}
        friction = recorded_friction(identified)
        return LawOnGrid(
            law, exported=material, friction=friction, constants=known.get("constants"), **options
        )

    def uncertainty_inputs(self, case: Case) -> Files:
        return self.model_inputs(case)
