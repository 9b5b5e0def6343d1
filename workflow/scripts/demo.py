"""Page of the demo: its files, and the errors of the motions."""

from pathlib import Path

from neuma_lib.io.files import listed, read_json, write_text
from workflow.stage import run_script

PAGE = """\
# What was learned

![the video and the motions of the table]({gif})

| motion | error in 3D (RMSE) | what it is |
|---|---:|---|
{rows}

- film: {film}
- law: {law}, by `neuma_lib.io.laws.load_law` or as the `prior` of a scene ([its curves]({page}))
{viewer}"""


SENTENCES = {
    "nclaw": "The law that is assumed before the video.",
    "neuma": "The paper's method: a low-rank correction of the prior, trained from the pixels of one camera.",
    "neuma_structured": "The elastic or plastic family and constants that fit the video best, corrected by small "
    "networks.",
}
"""What methods are. Others have their note in the settings."""


def main(inputs, output, params, run) -> None:
    folder = Path(output.page).parent
    place = {name: Path(inputs[name]).relative_to(folder) for name in ("gif", "film", "law", "page")}
    errors = [read_json(file)["tracer_rmse_mm"] for file in inputs.metrics]
    rows = [
        f"| {title} | {error:.1f} mm | {SENTENCES.get(method) or note or ''} |"
        for method, title, note, error in zip(
            params.methods, params.titles, params.notes, errors, strict=True
        )
    ]
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
