"""Write the video of a take in simulation time, with the colours of the photographs, at the size of training."""

from pathlib import Path

import numpy as np

from neuma_lib.capture.masks.mattes import write_labels
from neuma_lib.capture.motion.synchronisation import (
    chosen_frames,
    frame_times,
    reduced,
    reduced_intrinsics,
    reduced_labels,
    without_gain,
)
from neuma_lib.capture.pictures import write_png
from neuma_lib.io.files import listed, read_json
from neuma_lib.io.images import read_image_set, read_labels, read_transforms, write_transforms
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    registrations = [read_json(file) for file in listed(inputs.registration)]  # of each body
    folder, entries = Path(output.transforms).parent, []
    folder.mkdir(parents=True, exist_ok=True)
    Path(output.transforms).unlink(missing_ok=True)  # a folder without it is incomplete
    files = zip(
        params.cameras,
        listed(inputs.transforms),
        listed(inputs.timelines),
        params.timing["row_times"],
        params.exposures,
        strict=True,
    )
    for view, (camera, transforms, timeline, row_time, exposure) in enumerate(files):
        data, images = read_transforms(transforms), read_image_set(transforms).images
        labels = read_labels(transforms) if len(registrations) > 1 else None
        surest = min(registrations, key=lambda each: each["offsets_std_s"][camera])
        gain = np.mean([each["gains"][camera] for each in registrations], axis=0)
        frames = data["frames"]
        times = frame_times(frames, images, row_time, read_json(timeline)["height"])
        times += surest["offsets_s"][camera] - surest["t0_s"]
        chosen = chosen_frames(times, params.duration, params.frames, f"{params.name}, {camera}")
        for k in chosen:
            pixels = reduced(without_gain(images[k], gain), params.width)
            name = f"{camera}_{frames[k]['step']:05d}.png"
            write_png(folder / name, pixels)
            entry = {
                "file_path": name,
                "transform_matrix": frames[k]["transform_matrix"],
                **reduced_intrinsics(frames[k], pixels.shape[1::-1]),
                "view": view,
                "camera": camera,
                "frame": frames[k]["step"],
                "step": int(round(times[k] / params.dt)),
                "time": float(times[k]),
            }
            if labels is not None:
                small = reduced_labels(labels[k], pixels.shape[1::-1], len(registrations))
                entry["label_path"] = write_labels(folder, name, small)
            entries.append(entry | ({"exposure": exposure} if exposure else {}))
        run.log(f"{camera}: {len(chosen)} of {len(frames)} frames in the first {times[chosen[-1]]:.3f} s")
    entries = [entry for entry in entries if entry["step"] >= 0]
    write_transforms(output.transforms, {}, entries, **{k: data[k] for k in ("world", "room") if k in data})


run_script(main, snakemake)
