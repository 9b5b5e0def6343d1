"""Predict the silhouettes of a released body from mu / rho of the hanging one, and fit them."""

from neuma_lib.capture.calibration.marker import marker_poses
from neuma_lib.config.stills import RestingBodyConfig, SwingConfig
from neuma_lib.evaluation.plotting.specimens import swing_figure
from neuma_lib.evaluation.plotting.style import save
from neuma_lib.fitting.swing import swing_record
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
            predicted, fitted = own["predicted"], own["fitted"]
            run.log(
                f"{name}, cells of {1e3 * own['cell']:g} mm: contour {predicted['contour_rms']:.2f} px predicted, "
                f"{fitted['contour_rms']:.2f} px fitted with {fitted['ratio'] / clamp['hang']:.3f} times the stiffness"
            )
    save(swing_figure(result), output.figure)


run_script(main, snakemake)
