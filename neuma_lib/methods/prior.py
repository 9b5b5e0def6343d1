"""The prior without adaptation (NCLaw): nothing is learned from the video."""

from neuma_lib.config.motion import MotionOptions, WithPrior
from neuma_lib.methods.base import Case, Files, Method, ModelSource, Preset


class PriorOptions(MotionOptions, WithPrior):
    """Options of the prior."""


class Prior(Method):
    name = "prior"
    Options = PriorOptions
    presets = {"nclaw": Preset("NCLaw")}

    def model_inputs(self, case: Case) -> Files:
        return {"prior": case.prior_file()}

    def learns_from_video(self, case: Case) -> bool:
        return False

    def load(self, inputs, options, dt):
        from neuma_lib.io.laws import load_law
        from neuma_lib.methods.model import LawOnGrid

        return LawOnGrid(load_law(inputs["prior"], dt=dt))


def prior_source(path: str, dt: float) -> ModelSource:
    """A law that one file contains: a prior or an exported law."""
    return ModelSource(Prior.__module__, {}, {"prior": path}, dt)
