"""The benchmark of random scenes as a table."""

from neuma_lib.io.files import read_json, write_text
from neuma_lib.paper.random_scenes import random_table
from neuma_lib.paper.results import read_results
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    metrics = read_results(inputs.metrics, params.titles, params.scenes)
    scenes = [
        {
            "name": name,
            **known,
            "metrics": {method: row[name] for method, row in metrics.items()},
            "start": read_json(start),
        }
        for (name, known), start in zip(params.scenes.items(), inputs.starts, strict=True)
    ]
    csv, markdown, sentences = random_table(scenes, params.titles, params.seed, params.development)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    for sentence in sentences:
        run.log(sentence)


run_script(main, snakemake)
