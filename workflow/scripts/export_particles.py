"""Write the particles of every frame as PLY files, and of all frames as one HDF5 file."""

from pathlib import Path

import numpy as np

from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.particles import load_initial_state
from neuma_lib.io.ply import write_ply
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    files = (inputs.particles, inputs.binding, inputs.gaussians, inputs.velocity)
    start, counts = load_initial_state(*files, params.densities, params.particle_source)
    names = ("x", "F", "frames")
    path, attributes = read_arrays(inputs.rollout, required=names, only=names)
    for k, (x, F) in enumerate(zip(path["x"], path["F"], strict=True)):
        rows = np.empty(len(x), dtype=[(name, "<f4") for name in (*"xyz", "volume_ratio")])
        for name, column in zip(rows.dtype.names, [*x.T, np.linalg.det(F.astype(np.float64))], strict=True):
            rows[name] = column
        write_ply(Path(output.frames, f"{k:04d}.ply"), rows)
    vol0, mass = (getattr(start, name).numpy() for name in ("vol0", "mass"))
    time = path["frames"] * attributes["dt"]
    bodies = [
        {"name": body.get("name", body["scene"]), "particles": count}
        for body, count in zip(read_json(inputs.velocity).get("bodies", ()), counts, strict=False)
    ]
    arrays = {"x": path["x"], "time": time, "vol0": vol0, "mass": mass}
    write_arrays(output.together, arrays, {"bodies": bodies} if bodies else {})
    run.log(f"{len(path['x'])} frames of {len(start.x)} particles")


run_script(main, snakemake)
