"""Fit or predict mu / rho of a body at rest from the stills of its record."""

from neuma_lib.capture.calibration.marker import marker_poses
from neuma_lib.config.stills import RestingBodyConfig
from neuma_lib.fitting.resting_records import fit_record, predict_record
from neuma_lib.io.datasets.stills import read_stills
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.mesh_files import read_any_mesh
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = RestingBodyConfig(**params.body)
    mesh, stills = read_any_mesh(inputs.mesh), read_stills(params.root, settings.record)
    poses = marker_poses(stills[0].marker, stills[0].marker_pixels, stills[0].K)
    if settings.predicted_from:
        source = read_json(inputs.source)["clamps"]
        ratios = {name: values["ratio"] for name, values in source.items()}
        result = predict_record(mesh, settings, stills, poses, params.sizes[1], ratios, run.progress)
    else:
        result = fit_record(mesh, settings, stills, poses, params.sizes, run.progress)
    result["predicted_from"] = settings.predicted_from
    write_json(output.result, result)
    for name, values in result["clamps"].items():
        run.log(f"{name}: mu / rho {values['ratio']:.1f} m^2/s^2, contour {values['contour_rms']:.2f} px")


run_script(main, snakemake)
