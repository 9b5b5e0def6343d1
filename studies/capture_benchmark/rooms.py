"""Captures in furnished rooms, from files to a report or a refusal, compared with the truth.

    python -m studies.capture_benchmark.rooms                       # all twelve of rooms.yaml, one at a time
    python -m studies.capture_benchmark.rooms duck_handheld         # some of them
    python -m studies.capture_benchmark.rooms --to motion.md        # only masks, poses, scale, up and flight
    python -m studies.capture_benchmark.rooms --compare             # only compare what is there

Blender makes the files of a capture. The ordinary workflow then runs on its folder alone, as on that of a user, to the
report of the method `constants`. Only the comparison reads the truth. Results are written to `rooms/results/rooms.json`
and as a table to standard output.
"""

import argparse
import re
import resource
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.capture.calibration.lens import read_lens
from neuma_lib.config.capture import CaptureConfig
from neuma_lib.config.validation import validate
from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.io.files import read_json, write_json, write_text
from neuma_lib.io.images import read_transforms
from neuma_lib.paper.identified_table import FITS, MATERIAL, compare_family, compare_quantities
from neuma_lib.project.loading import read_yaml
from studies.capture_benchmark.evaluation import compare_cameras, photograph_agreement, video_agreement
from studies.capture_benchmark.planned import PREFIX
from studies.capture_benchmark.sets import body_at_rest, body_of_drop
from studies.capture_benchmark.settings import DemoCapturesConfig

SETTINGS = Path("studies/capture_benchmark/rooms.yaml")
REPORT = "constants/report.html"
DEVIATIONS = 2.0  # half width of the band around a constant, in standard deviations of the logarithm


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("names", nargs="*", help="captures; all by default")
    parser.add_argument("--compare", action="store_true", help="run nothing")
    parser.add_argument("--to", default=REPORT, help="last file of a capture's results")
    parser.add_argument("--cores", default="1", help="of Snakemake")
    args = parser.parse_args()
    settings = read_yaml(SETTINGS)
    demo = validate(DemoCapturesConfig, settings.pop("capture_benchmark"), "capture_benchmark")
    results = Path(settings["results_root"])
    if unknown := set(args.names) - set(demo.objects):
        parser.error(f"unknown captures {', '.join(sorted(unknown))}")
    ordinary = results / "settings.yaml"
    write_text(ordinary, "".join(f"{key}: {value!r}\n" for key, value in settings.items()))
    rows = read_json(results / "rooms.json") if (results / "rooms.json").exists() else {}
    for name in args.names or demo.objects:
        row = rows.setdefault(name, {})
        if not args.compare:
            capture = Path(settings["captures"]["root"]) / (PREFIX + name)
            files = [capture / "capture.yaml"]
            files += [capture / f"videos/first/{camera}.mp4" for camera in sorted(demo.cameras)]
            # Snakemake would render them again for a newer file of the truth, and rendering takes longest.
            if not all(file.exists() for file in files):
                study = ["--snakefile", "studies/capture_benchmark/Snakefile", "--configfile", str(SETTINGS)]
                _, output = snakemake([*study, "--cores", args.cores, "--", *map(str, files)])
                if not all(file.exists() for file in files):
                    raise SystemExit(f"{capture}: not rendered\n{output}")
            last = results / (PREFIX + name) / args.to
            run = ["--configfile", str(ordinary), "--cores", args.cores, "--", str(last)]
            seconds, output = snakemake(run)
            row["core_seconds"] = row.get("core_seconds", 0) + seconds
            write_text(results / "output" / f"{name}.txt", output)
            row["end"] = last.stem if last.exists() else refusal(output)
        if row:
            row |= compare(demo, name, settings)
        write_json(results / "rooms.json", rows)
        print(name, row, flush=True)
    print(table(demo, {name: row for name, row in rows.items() if row}))


def snakemake(arguments: Sequence[str]) -> tuple[float, str]:
    """Run Snakemake and return its core seconds and output."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "snakemake", "--nolock", *arguments]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return seconds, done.stdout


def refusal(output: str) -> str:
    """The message of the stage that stopped."""
    messages = re.findall(r"^.*ERROR: (.*?)(?: \(more in .*)?$", output, flags=re.M)
    return messages[0] if messages else output.strip()[-300:]


def compare(demo: DemoCapturesConfig, name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """What the stages that ran found, compared with the truth: plain values."""
    results = Path(settings["results_root"]) / (PREFIX + name)
    data, true = Path(settings["data_root"]), Path(settings["data_root"]) / "captures_demo" / name
    room, row = data / (PREFIX + name) / "room/transforms.json", {}
    if not (results / "room.json").exists() or not room.exists():
        return row
    known, report = read_json(true / "truth.json"), read_json(results / "room.json")
    photographs = {Path(file).stem: camera for file, camera in known["photographs"].items()}
    errors = {
        each.what: each.value
        for each in compare_cameras(read_transforms(room)["frames"], photographs, known["cameras"])
    }
    row["scale_percent"], row["up_deg"] = errors["scale, from the cameras"], errors["up, from the cameras"]
    lenses = {group: read_lens(lens, "room.json") for group, lens in report["lenses"].items()}
    longest = validate(CaptureConfig, {}).longest
    static = data / (PREFIX + name) / "static/transforms.json"
    if static.exists():
        rest = body_at_rest(demo, name)
        agreed = photograph_agreement(static, rest, photographs, lenses["photographs"], longest)
        row["iou_photographs"] = float(np.mean(agreed))
    body, values = None, []
    for camera in sorted(demo.cameras):
        path = data / (PREFIX + name) / f"videos/first/{camera}/transforms.json"
        if path.exists():
            if body is None:
                body, numbers = body_of_drop(demo, name, "first", true / "first.h5")
            values += video_agreement(
                path,
                body,
                numbers[camera],
                known["cameras"][camera],
                lenses[camera],
                longest,
                demo.objects[name].difficulties.repeats,
            )
    if values:
        row["iou_videos"] = float(np.mean(values))
    scene = results.with_name(f"{results.name}_first")
    for kind, path in (("flight", results / "flight/first.json"), ("placed", scene / "registration.json")):
        if path.exists():
            report = read_json(path)
            row[f"gravity_{kind}"] = [report["gravity_ratio"], report["gravity_angle_deg"]]
    for path in scene.glob("identified*.json"):
        identified = read_json(path)
        row["family"] = f"{identified['family']} ({compare_family(identified, known['law'])})"
        row["quantities"] = {of: compare_quantities(identified, known["law"], of) for of in FITS}
    return row


def table(demo: DemoCapturesConfig, rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Markdown with a row for each capture."""
    heads = ["capture", "board", "end", "scale [%]", "up [°]", "IoU, photographs", "IoU, videos"]
    heads += ["gravity, placed", "family", "determined", "in 2 std", "core s"]
    cells = []
    for name, row in rows.items():
        sure = [q for q in row.get("quantities", {}).get(MATERIAL, []) if q["determined"]]
        gravity = row.get("gravity_placed") or row.get("gravity_flight")
        cells.append(
            [
                name,
                "yes" if demo.objects[name].difficulties.board else "no",
                row.get("end", ""),
                *(f"{row[k]:.3g}" if k in row else "" for k in ("scale_percent", "up_deg")),
                *(f"{row[k]:.3f}" if k in row else "" for k in ("iou_photographs", "iou_videos")),
                f"{gravity[0]:.3f}, {gravity[1]:.1f}°" if gravity else "",
                row.get("family", ""),
                ", ".join(f"{q['quantity']} {q['error_percent']:+.0f} %" for q in sure),
                f"{sum(abs(q['error_in_std']) < DEVIATIONS for q in sure)} of {len(sure)}" if sure else "",
                f"{row['core_seconds']:.0f}" if "core_seconds" in row else "",
            ]
        )
    return "\n".join(as_markdown(heads, cells))


if __name__ == "__main__":
    main()
