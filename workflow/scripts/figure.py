"""Draw one figure from its data file."""

from importlib import import_module
from pathlib import Path

from neuma_lib.evaluation.figures.panels import load_panels
from neuma_lib.evaluation.figures.style import save
from neuma_lib.io.files import read_json
from workflow.stage import stage


def main(name: str, data_file: str, output, run) -> None:
    data = load_panels(data_file) if Path(data_file).suffix == ".h5" else read_json(data_file)
    figure = import_module(f"neuma_lib.evaluation.figures.{name}").draw(data)
    save(figure, output.png, output.pdf)
    width, height = figure.get_size_inches()
    run.say(f"{width:.1f} x {height:.1f} in: {output.png}")


if __name__ == "__main__":
    with stage(f"figure {snakemake.params.figure}", snakemake.log[0]) as run:
        main(snakemake.params.figure, snakemake.input.data, snakemake.output, run)
