"""Report of a capture: comparison with every video, measures, the law, warnings, checks and input."""

from pathlib import Path

from neuma_lib.capture.report.page import checks, motion_checks, object_checks, registration_checks
from neuma_lib.capture.report.report import Film, page
from neuma_lib.capture.report.warnings import (
    check_warnings,
    constants_warnings,
    curve_warnings,
    filming_warnings,
    prediction_warnings,
)
from neuma_lib.io.files import listed, read_json, write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    facts, method = params.facts, params.method
    released = "room" not in inputs.keys()  # released captures come with poses and masks
    videos = [tuple(video) for video in params.videos]
    takes, motions = list(facts["throws"]), params.motions  # a motion is that of a body in a take
    names, masks = ([f"{take}, {camera}" for take, camera in each] for each in (videos, params.filmed))

    def named(titles, files):
        return dict(zip(titles, map(read_json, listed(files)), strict=True))

    flights, registrations = named(motions, inputs.flights), named(motions, inputs.registrations)
    predictions, rows = named(takes, inputs.predictions), read_json(inputs.images)
    curves = read_json(inputs.curves)
    identified = read_json(inputs.identified) if inputs.identified else None
    photographs = read_json(inputs.photographs)
    groups, pictures = {}, {}
    if not released:
        groups["Frames, cameras, room"] = checks(read_json(inputs.room), named(names, inputs.timelines))
        pictures["Cameras and room"] = {"Cameras and points": inputs.cameras, "Floor and box": inputs.floor}
        pictures["Videos"] = {f"Frames: {n}": file for n, file in zip(names, listed(inputs.frame_sheets))}
    groups |= {
        "Masks and free flight": motion_checks(photographs, named(masks, inputs.masks), flights),
        "Gaussians of the object": object_checks(named(params.objects, inputs.objects)),
        "Registration": registration_checks(registrations),
    }
    filmed = {
        take: {
            "cameras": cameras,
            "flights": {m: flights[m] for m in motions if m.partition(", ")[0] == take},
            "registrations": {m: registrations[m] for m in motions if m.partition(", ")[0] == take},
            "prediction": predictions[take],
        }
        for take, cameras in facts["throws"].items()
    }
    warnings = [
        *check_warnings(groups),
        *prediction_warnings(rows, method, params.prior, params.constants, predictions),
        *constants_warnings(identified),
        *curve_warnings(curves, params.titles, params.prior, params.constants),
        *filming_warnings(facts, filmed),
    ]
    pictures |= {
        "Photographs": {"Masks of the photographs": inputs.photograph_sheet},
        "Masks of the videos": {f"Masks: {n}": file for n, file in zip(masks, listed(inputs.mask_sheets))},
        "Free flight": {
            f"Free flight: {m}": file for m, file in zip(motions, listed(inputs.flight_pictures))
        },
        "Registration": {
            f"Registration: {m}": file for m, file in zip(motions, listed(inputs.registration_pictures))
        },
    }
    means = {(row["throw"], row["camera"]): row for row in rows if row["method"] == method}
    films = [
        Film(
            take,
            camera,
            take not in facts["held_out"],
            Path(file),
            "PSNR {psnr:.1f} dB, LPIPS {lpips_vgg:.3f} on the object".format(**means[take, camera]),
        )
        for (take, camera), file in zip(videos, listed(inputs.films), strict=True)
    ]
    cameras = {camera for filming in facts["throws"].values() for camera in filming}
    held = f", {', '.join(facts['held_out'])} held out" if facts["held_out"] else ""
    densities = ", ".join(
        f"{density['value']:g}" + (f" ({body})" if body else "")
        for body, density in facts["densities"].items()
    )
    summary = [
        f"{_counted(photographs['photographs'], 'photograph')}, {_counted(len(takes), 'take')}{held}, "
        f"{_counted(len(cameras), 'camera')}. Prior: {facts['prior']}, density {densities} kg/m³, "
        f"time step {1e3 * facts['dt']:g} ms, training pictures of {facts['width']} pixels."
    ]
    html = page(
        params.capture,
        params.titles[method],
        summary=summary,
        warnings=warnings,
        checks=groups,
        pictures=pictures,
        films=films,
        rows=rows,
        own=method,
        curves=Path(inputs.curves_picture),
        identified=identified,
        scale=facts["scale"],
    )
    write_text(output.page, html)
    failed = sum(not check.good for group in groups.values() for check in group)
    run.log(f"{len(films)} videos, {failed} failed checks, {len(warnings)} warnings: {output.page}")


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


run_script(main, snakemake)
