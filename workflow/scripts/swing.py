"""Predict the silhouettes of a released body from mu / rho of the hanging one, and fit them."""

from neuma_lib.capture.calibration.marker import marker_poses
from neuma_lib.config.stills import RestingBodyConfig, SwingConfig
from neuma_lib.evaluation.plotting.specimens import swing_figure
from neuma_lib.evaluation.plotting.style import save
from neuma_lib.fitting.swing import FITS, swing_record
from neuma_lib.io.datasets.stills import read_stills, read_swing
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.mesh_files import read_any_mesh
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings, swing = RestingBodyConfig(**params.body), SwingConfig(**params.swing)
    held = read_stills(params.root, swing.still)[0]
    frames = read_swing(params.root, swing.silhouettes)
    poses = marker_poses(held.marker, held.marker_pixels, held.K)
    ratios = {name: values["ratio"] for name, values in read_json(inputs.source)["clamps"].items()}
    mesh, options = read_any_mesh(inputs.mesh), (params.size, params.cells, run.progress)
    result = swing_record(mesh, settings, swing, held, frames, poses, ratios, *options)
    write_json(output.result, result)
    for name, clamp in result["clamps"].items():
        for own in clamp["grids"]:
            for key in FITS:
                contour, stiffness = own[key]["contour_rms"], own[key]["ratio"] / clamp["hang"]
                where = f"{name}, cells of {1e3 * own['cell']:g} mm, {key}"
                run.log(f"{where}: contour {contour:.2f} px, {stiffness:.3f} times the stiffness of the hang")
    save(swing_figure(result), output.figure)


run_script(main, snakemake)
