"""Draw what was identified in a scene: families by held-out loss, constants with their uncertainty."""

from neuma_lib.evaluation.plotting.style import save
from neuma_lib.io.files import read_json
from neuma_lib.paper.identified_page import identified_page
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    figure = identified_page(read_json(inputs.identified), params.law)
    save(figure, output.page)


run_script(main, snakemake)
