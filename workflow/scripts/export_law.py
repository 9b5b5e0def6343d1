"""Write a method's law into one file, with what is known of it, and draw what it says."""

from neuma_lib.evaluation.law_export import export_law, head_commit
from neuma_lib.io.laws import load_laws
from workflow.inputs import listed
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    files = [listed(inputs.get(name)) for name in ("identified", "prior", "adaptor")]
    (law,) = load_laws(params.origin["dt"], params.laws, *files)
    beside = {name: inputs.get(name) or None for name in ("metrics", "rollout")}
    known = {**params.origin, "commit": head_commit("."), **beside}
    about = export_law(output.law, law, page=output.page, **known)
    run.say(f"{about['kind']}, learned at dt = {about['dt']:g} s")


run_script(main, snakemake)
