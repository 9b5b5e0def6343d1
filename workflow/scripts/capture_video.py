"""Write the video of a take in simulation time, with the colours of the photographs, at the size of training."""

from pathlib import Path

from neuma_lib.capture.motion.synchronisation import (
    chosen_frames,
    frame_times,
    reduced,
    reduced_intrinsics,
    without_gain,
)
from neuma_lib.capture.pictures import write_png
from neuma_lib.io.files import listed, read_json
from neuma_lib.io.images import read_image_set, read_transforms, write_transforms
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    registration = read_json(inputs.registration)
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
        frames = data["frames"]
        times = frame_times(frames, images, row_time, read_json(timeline)["height"])
        times += registration["offsets_s"][camera] - registration["t0_s"]
        chosen = chosen_frames(times, params.duration, params.frames, f"{params.name}, {camera}")
        for k in chosen:
            pixels = reduced(without_gain(images[k], registration["gains"][camera]), params.width)
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
            entries.append(entry | ({"exposure": exposure} if exposure else {}))
        run.log(f"{camera}: {len(chosen)} of {len(frames)} frames in the first {times[chosen[-1]]:.3f} s")
    entries = [entry for entry in entries if entry["step"] >= 0]
    write_transforms(output.transforms, {}, entries, **{k: data[k] for k in ("world", "room") if k in data})


run_script(main, snakemake)
