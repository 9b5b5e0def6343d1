"""One page of a capture: prediction beside every video, measures, the law, what to distrust, checks, and input."""

from pathlib import Path

from neuma_lib.capture.page import checks, motion_checks, object_checks, registration_checks
from neuma_lib.evaluation.capture_doubts import (
    of_checks,
    of_constants,
    of_curves,
    of_filming,
    of_predictions,
)
from neuma_lib.evaluation.capture_report import Film, Report, page
from neuma_lib.io.files import listed, read_json, write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    facts, method = params.facts, params.method
    of_others = "room" not in inputs.keys()  # poses and masks came with a released capture
    videos = [tuple(video) for video in params.videos]
    names, throws = [f"{throw}, {camera}" for throw, camera in videos], list(facts["throws"])

    def by_throw(files):
        return dict(zip(throws, map(read_json, listed(files)), strict=True))

    def by_video(files):
        return dict(zip(names, map(read_json, listed(files)), strict=True))

    flights, registrations = by_throw(inputs.flights), by_throw(inputs.registrations)
    predictions, rows = by_throw(inputs.predictions), read_json(inputs.images)
    curves = read_json(inputs.curves)
    identified = read_json(inputs.identified) if inputs.identified else None
    groups = (
        {}
        if of_others
        else {"Frames, cameras, room": checks(read_json(inputs.room), by_video(inputs.timelines))}
    )
    photographs = read_json(inputs.photographs)
    groups |= {
        "Masks and free flight": motion_checks(photographs, by_video(inputs.masks), flights),
        "The object as photographed": object_checks(read_json(inputs.object)),
        "Its place in the videos": registration_checks(registrations),
    }
    filmed = {
        throw: {
            "cameras": cameras,
            "flight": flights[throw],
            "registration": registrations[throw],
            "prediction": predictions[throw],
        }
        for throw, cameras in facts["throws"].items()
    }
    said = [
        *of_checks(groups),
        *of_predictions(rows, method, params.prior, params.constants, predictions),
        *of_constants(identified),
        *of_curves(curves, params.titles, params.prior, params.constants),
        *of_filming(facts, filmed),
    ]
    pictures = (
        {}
        if of_others
        else {
            "Cameras and room": {"Cameras and points": inputs.cameras, "Floor and box": inputs.floor},
            "Videos": {f"Frames: {n}": file for n, file in zip(names, listed(inputs.frame_sheets))},
        }
    )
    pictures |= {
        "Photographs": {"Masks of the photographs": inputs.photograph_sheet},
        "Masks of the videos": {f"Masks: {n}": file for n, file in zip(names, listed(inputs.mask_sheets))},
        "Free flight": {f"Free flight: {t}": file for t, file in zip(throws, listed(inputs.flight_pictures))},
        "Place of the object in the videos": {
            f"Registration: {t}": file for t, file in zip(throws, listed(inputs.registration_pictures))
        },
    }
    means = {(row["throw"], row["camera"]): row for row in rows if row["method"] == method}
    films = [
        Film(
            throw,
            camera,
            throw not in facts["held_out"],
            Path(file),
            "PSNR {psnr:.1f} dB, LPIPS {lpips_vgg:.3f} on the object".format(**means[throw, camera]),
        )
        for (throw, camera), file in zip(videos, listed(inputs.films), strict=True)
    ]
    cameras = {camera for filming in facts["throws"].values() for camera in filming}
    held = f", {', '.join(facts['held_out'])} held out" if facts["held_out"] else ""
    summary = [
        f"{_counted(photographs['photographs'], 'photograph')}, {_counted(len(throws), 'throw')}{held}, "
        f"{_counted(len(cameras), 'camera')}. Prior: {facts['prior']}, density {facts['density']:g} kg/m³, "
        f"steps of {1e3 * facts['dt']:g} ms, learned from pictures of {facts['width']} pixels."
    ]
    report = Report(
        params.capture,
        params.titles[method],
        summary,
        said,
        groups,
        pictures,
        films,
        rows,
        method,
        Path(inputs.curves_picture),
        identified,
        facts["scale"],
    )
    write_text(output.page, page(report))
    off = sum(not check.good for found in groups.values() for check in found)
    run.say(f"{len(films)} videos, {off} checks are off, {len(said)} things to distrust: {output.page}")


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


run_script(main, snakemake)
