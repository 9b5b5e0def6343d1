"""Judge what training starts from against the truth: static fit, mesh, particles, velocity."""

import numpy as np

from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import volume_iou
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_particles
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    scene = params.scene
    fit, velocity = read_json(inputs.gaussians), read_json(inputs.velocity)
    x0, _, attributes = load_particles(inputs.particles)
    mesh, true_mesh = (
        read_mesh(inputs.mesh),
        place(scene["shape"], scene["size"], scene["height"], scene["center"]),
    )
    error = np.asarray(velocity["v0"]) - np.asarray(scene["velocity"])
    in_camera = np.asarray(velocity["camera_axes"]) @ error
    free = np.asarray(velocity["without_ridge"]["v0"]) - np.asarray(scene["velocity"])
    speed = float(np.linalg.norm(scene["velocity"]))
    added = int(attributes["added"])
    report = {
        "gaussians": fit["count"],
        "psnr": fit["psnr"],
        "psnr_object": fit["psnr_object"],
        "volume_iou": float(volume_iou(mesh, true_mesh)),
        "volume_ratio": float(mesh.volume / true_mesh.volume),
        "particles_asked": params.particles,
        "particles": len(x0) - added,
        "particles_added": added,
        "velocity": velocity["v0"],
        "velocity_true": scene["velocity"],
        "velocity_error_in_plane_percent": float(100 * np.linalg.norm(in_camera[:2]) / speed),
        "velocity_error_depth": float(in_camera[2]),
        "velocity_error_depth_without_ridge": float(np.asarray(velocity["camera_axes"])[2] @ free),
        "velocity_std_depth": velocity["std_camera"][2],
    }
    write_json(output.report, report)
    run.say(
        f"PSNR {report['psnr']:.1f} dB, volume IoU {report['volume_iou']:.3f}, {report['particles']} particles"
        f" (+{added}), velocity error {report['velocity_error_in_plane_percent']:.2f} % in plane,"
        f" {report['velocity_error_depth']:+.3f} m/s in depth"
    )


run_script(main, snakemake)
