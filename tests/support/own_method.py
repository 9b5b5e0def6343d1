"""A modulus from the mean brightness of the video: of no use, but short."""

from pydantic import Field

from neuma_lib.config.motion import MotionOptions
from neuma_lib.methods.base import Method, Preset


class BrightnessOptions(MotionOptions):
    scale: float = Field(1e5, gt=0, description="Young's modulus of a white video [Pa]")


class Brightness(Method):
    name = "brightness"
    Options = BrightnessOptions
    product = "modulus.json"
    fit_kernels = ()
    presets = {"brightness": Preset("Brightness", {"scale": 2e5}, note="One number.")}

    def fit_inputs(self, case):
        return {"transforms": case.data("dynamic/transforms.json")}

    def model_inputs(self, case):
        return {"modulus": case.product()}

    def fit(self, inputs, options, problem, run):
        from neuma_lib.io.files import write_json
        from neuma_lib.io.images import load_videos

        video, *_ = load_videos(inputs["transforms"], options["views"], **problem.exposure)
        modulus = options["scale"] * float(video.images.float().mean()) / 255
        write_json(run.product, {"E": modulus})
        write_json(run.history, {"scale": options["scale"]})
        run.log(f"E = {modulus:.4g} Pa")

    def load(self, inputs, options, dt):
        from neuma_lib.io.files import read_json
        from neuma_lib.mechanics.analytic import analytic_law
        from neuma_lib.methods.model import LawOnGrid

        modulus = read_json(inputs["modulus"])["E"]
        law = {"elasticity": {"name": "cubic_hencky", "E": modulus, "nu": 0.3, "b": 10.0}}
        return LawOnGrid(analytic_law(law, dt=dt))
