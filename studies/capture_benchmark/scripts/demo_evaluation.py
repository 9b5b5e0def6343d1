"""Compare results of the demo captures with the ground truth and with goals."""

import csv
import io
from pathlib import Path

from neuma_lib.capture.calibration.lens import read_lens
from neuma_lib.io.files import read_json, write_text
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import read_transforms
from studies.capture_benchmark.evaluation import (
    Truth,
    compare_cameras,
    compare_flight,
    compare_masks,
    compare_motion,
    compare_registration,
    photograph_agreement,
    table,
    tracer_error,
    video_agreement,
)
from studies.capture_benchmark.sets import body_at_rest, body_of_drop
from studies.capture_benchmark.settings import DemoCapturesConfig
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    demo, files = DemoCapturesConfig(**params.demo), params.files
    rows = []
    for number, name in enumerate(demo.objects):
        capture, known = params.captures[name], read_json(files[name]["truth"])
        lenses = {
            group: read_lens(lens, "room.json")
            for group, lens in read_json(files[name]["report"])["lenses"].items()
        }
        room = read_transforms(files[name]["room"])
        photographs = {Path(file).stem: camera for file, camera in known["photographs"].items()}
        cameras = compare_cameras(room["frames"], photographs, known["cameras"])
        rest = body_at_rest(demo, name)
        static, longest = files[name]["static"], params.longest[name]
        agreed = photograph_agreement(static, rest, photographs, lenses["photographs"], longest)
        agreements = {"photographs": agreed}
        rows += [(capture, "", row) for row in cameras + compare_masks(agreements)]
        for drop in demo.objects[name].drops:
            of_drop = compare_drop(demo, name, drop, known, lenses, files[name], params)
            rows += [(capture, drop, row) for row in of_drop]
        run.progress(number + 1, len(demo.objects))
    markdown, cells = table(rows)
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(cells)
    write_text(output.csv, text.getvalue())
    write_text(output.page, "# The demo captures compared with the ground truth\n\n" + markdown)
    missed = [row.what for _, _, row in rows if row.reached is False]
    run.log(f"{sum(row.reached is True for _, _, row in rows)} goals reached, {len(missed)} missed")


def compare_drop(demo, name, drop, known, lenses, files, params):
    of_drop = files["drops"][drop]
    arrays, _ = read_arrays(of_drop["particles"], ("time", "x", "mass", "tracers"))
    truth = Truth(*(arrays[key] for key in ("time", "x", "mass", "tracers")))
    body, numbers = body_of_drop(demo, name, drop, of_drop["particles"])
    longest, repeats = params.longest[name], demo.objects[name].difficulties.repeats
    agreements = {}
    for camera, path in of_drop["mattes"].items():
        true = known["cameras"][camera], lenses[camera]
        agreements[camera] = video_agreement(path, body, numbers[camera], *true, longest, repeats)
    rows = compare_masks(agreements) + compare_flight(read_json(of_drop["flight"]), known, truth, drop)
    if of_drop["registration"]:
        registration = read_json(of_drop["registration"])
        rows += compare_registration(registration, read_json(of_drop["velocity"]), known, truth, drop)
        start = known["cameras"][min(registration["offsets_s"])]["offset_s"] + registration["t0_s"]
        errors = {}
        for method, path in of_drop["rollouts"].items():
            motion, attributes = read_arrays(path, ("x", "frames"), ("x", "frames"))
            errors[method] = tracer_error(motion["x"], motion["frames"] * attributes["dt"], truth, start)
        rows += compare_motion(errors, params.prior, drop in known["held_out"])
    return rows


run_script(main, snakemake)
