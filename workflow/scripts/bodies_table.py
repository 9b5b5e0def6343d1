"""Table of the bodies of a scene."""

from neuma_lib.io.files import listed, read_json, write_text
from neuma_lib.paper.bodies_table import bodies_table
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    names = list(params.laws)
    files = {name: listed(inputs[name]) for name in ("alone", "alone_metrics")}
    alone, other = (dict(zip(names, map(read_json, own), strict=True)) for own in files.values())
    together = [read_json(file)["bodies"] for file in (inputs.true_law, inputs.metrics)]
    errors = {
        name: [*(bodies[k]["tracer_rmse_mm"] for bodies in together), other[name]["tracer_rmse_mm"]]
        for k, name in enumerate(names)
    }
    identified = read_json(inputs.identified)
    csv, markdown = bodies_table(identified, alone, params.laws, params.frictions, errors)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.log(f"{len(names)} bodies: {output.markdown}")


run_script(main, snakemake)
