"""Make one figure: gather its data, and draw it from the file that holds them."""

from importlib import import_module

from neuma_lib.evaluation.plotting.style import save
from neuma_lib.io.files import read_json, write_json
from neuma_lib.paper.image_grid import ImageGrid, load_image_grid, save_image_grid
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    module = import_module(f"neuma_lib.paper.figures.{params.figure}")
    data = module.data(inputs, params, run.log)
    in_pictures = isinstance(data, ImageGrid)
    (save_image_grid if in_pictures else write_json)(output.data, data)
    figure = module.draw((load_image_grid if in_pictures else read_json)(output.data))
    save(figure, output.png, output.pdf)
    width, height = figure.get_size_inches()
    run.log(f"{width:.1f} x {height:.1f} in: {output.png}")


run_script(main, snakemake)
