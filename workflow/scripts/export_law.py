"""Write a method's law into one file, with its origin and measures, and draw its curves."""

from neuma_lib.evaluation.law_export import export_law, head_commit
from workflow.motion import Prediction
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    model = Prediction(inputs, params.method).model(params.origin["dt"])
    measured = {name: inputs.get(name) or None for name in ("metrics", "rollout")}
    known = {**params.origin, "commit": head_commit("."), "constants": model.constants, **measured}
    if model.exported is not model.law:
        known["grid"] = None
    about = export_law(output.law, model.exported, page=output.page, **known)
    run.log(f"{about['kind']}, learned at dt = {about['dt']:g} s")


run_script(main, snakemake)
