"""The benchmark of random scenes as a table."""

from neuma_lib.io.files import read_json, write_text
from neuma_lib.paper.random_scenes import RandomScene, failure, random_table
from neuma_lib.paper.results import read_results
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    metrics = read_results(inputs.metrics, params.titles, params.scenes)
    failed = {
        scene: {method: what for method in metrics if (what := failure(metrics[method][scene]))}
        for scene in params.scenes
    }
    scenes = [
        RandomScene(
            name,
            **known,
            rmse={method: row[name]["tracer_rmse_mm"] for method, row in metrics.items()},
            failed=failed[name],
            start=read_json(start),
        )
        for (name, known), start in zip(params.scenes.items(), inputs.starts, strict=True)
    ]
    csv, markdown, sentences = random_table(scenes, params.titles, params.seed)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    for sentence in sentences:
        run.log(sentence)


run_script(main, snakemake)
