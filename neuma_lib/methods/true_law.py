"""The true law of the scene on the reconstructed body. Its error is that of reconstruction and initial motion."""

from neuma_lib.methods.base import Case, Files, Method, Preset


class TrueLaw(Method):
    name = "true_law"
    presets = {"true_law": Preset("True law")}

    def model_inputs(self, case: Case) -> Files:
        return {}

    def model_options(self, case: Case) -> dict:
        return {"law": case.scene_law}

    def load(self, inputs, options, dt):
        from neuma_lib.mechanics.analytic import analytic_law
        from neuma_lib.methods.model import LawOnGrid

        return LawOnGrid(analytic_law(options["law"], dt=dt))
