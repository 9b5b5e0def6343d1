"""Page of the demo: its files, and the errors of the motions."""

from pathlib import Path

from neuma_lib.io.files import listed, read_json, write_text
from workflow.stage import run_script

PAGE = """\
# What was learned

![video, prior and learned law]({gif})

| | error of the 3D motion (RMSE) |
|---|---:|
{rows}

- film: {film}
- law: {law}, by `neuma_lib.io.laws.load_law` or as the `prior` of a scene ([its curves]({page}))
{viewer}"""


def main(inputs, output, params, run) -> None:
    folder = Path(output.page).parent
    place = {name: Path(inputs[name]).relative_to(folder) for name in ("gif", "film", "law", "page")}
    errors = [read_json(file)["tracer_rmse_mm"] for file in inputs.metrics]
    rows = [f"| {title} | {error:.1f} mm |" for title, error in zip(params.titles, errors, strict=True)]
    viewer = listed(inputs.get("viewer"))
    line = f"- to play with: {Path(viewer[0]).relative_to(folder)}\n" if viewer else ""
    write_text(output.page, PAGE.format(rows="\n".join(rows), viewer=line, **place))
    errors_text = ", ".join(
        f"{title} {error:.1f} mm" for title, error in zip(params.titles, errors, strict=True)
    )
    run.log(
        f"error of the motion: {errors_text}. Open {', '.join([inputs.film, *viewer])}. All files: {output.page}"
    )


run_script(main, snakemake)
