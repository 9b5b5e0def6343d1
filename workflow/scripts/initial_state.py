"""Evaluate what training starts from against the truth: static fit, mesh, particles, velocity."""

import numpy as np

from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import volume_iou
from neuma_lib.io.files import listed, read_json, write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_particles
from workflow.inputs import solid
from workflow.stage import run_script

MIN_SPIN = 1.0
"""Errors of slower spins are given in percent of this [rad/s]: in the tenth of a second before contact it turns a body
by 6 degrees."""


def main(inputs, output, params, run) -> None:
    scene = params.scene
    fit, velocity = read_json(inputs.gaussians), read_json(inputs.velocity)
    x0, _, attributes = load_particles(inputs.particles)
    shape = solid(scene["shape"], iter(listed(inputs.meshes)))
    mesh = read_mesh(inputs.mesh)
    true_mesh = place(shape, scene["size"], scene["height"], scene["center"], rotation=scene["rotation"])
    axes, spin = np.asarray(velocity["camera_axes"]), np.asarray(scene["spin"])
    truth, _ = read_arrays(inputs.truth, required=("x", "mass"), only=("x", "mass"))
    centre = np.average(truth["x"][0], axis=0, weights=truth["mass"])
    # The true velocity where the estimated one is: at the reconstruction's centre of mass.
    v0 = np.asarray(scene["velocity"]) + np.cross(spin, np.asarray(velocity["centre"]) - centre)
    in_camera, free = (axes @ (np.asarray(fit["v0"]) - v0) for fit in (velocity, velocity["without_ridge"]))
    turning = axes @ (np.asarray(velocity["angular_velocity"]) - spin)
    speed, rate = float(np.linalg.norm(v0)), max(float(np.linalg.norm(spin)), MIN_SPIN)
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
        "velocity_true": v0.tolist(),
        "velocity_error_in_plane_percent": float(100 * np.linalg.norm(in_camera[:2]) / speed),
        "velocity_error_depth": float(in_camera[2]),
        "velocity_error_depth_without_ridge": float(free[2]),
        "velocity_std_depth": velocity["std_camera"][2],
        "angular_velocity": velocity["angular_velocity"],
        "angular_velocity_true": scene["spin"],
        "angular_velocity_error_camera": turning.tolist(),
        "angular_velocity_std_camera": velocity["angular_velocity_std_camera"],
        "angular_velocity_error_viewing_percent": float(100 * abs(turning[2]) / rate),
        "angular_velocity_error_percent": float(100 * np.linalg.norm(turning) / rate),
    }
    write_json(output.report, report)
    run.log(
        f"PSNR {report['psnr']:.1f} dB, volume IoU {report['volume_iou']:.3f}, {report['particles']} particles"
        f" (+{added}), velocity error {report['velocity_error_in_plane_percent']:.2f} % in plane,"
        f" {report['velocity_error_depth']:+.3f} m/s in depth, spin error {np.linalg.norm(turning):.2f} rad/s"
    )


run_script(main, snakemake)
