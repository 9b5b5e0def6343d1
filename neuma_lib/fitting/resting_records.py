"""Stiffness over density of a body from all stills of a record, under each clamp, on two meshes."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neuma_lib.config.obstacles import RegionConfig
from neuma_lib.config.stills import RestingBodyConfig
from neuma_lib.fitting.resting import RestingBody, StillFit, contours, fit_still
from neuma_lib.geometry.blocks import hexahedra
from neuma_lib.io.datasets.stills import Still
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.equilibrium import extrapolated

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

SURFACE = 0.005
"""Edge of the triangles of the surface [m]. On a beam that bends with a radius of 10 cm, chords are 0.03 mm inside."""
FIRST_RATIO = 60.0  # mu / rho before the fit [m^2/s^2]. Fits from 30 to 200 end at the same value.
_MODULUS = 100.0  # Pa


def resting_law(nu: float) -> dict[str, dict[str, float | str]]:
    """The law of bodies at rest, with any modulus, since only its ratio to the density matters."""
    return {"elasticity": {"name": "neo_hookean", "E": 2 * _MODULUS * (1 + nu), "nu": nu}}


def resting_body(
    mesh: trimesh.Trimesh,
    settings: RestingBodyConfig,
    clamp: RegionConfig,
    size: float,
    held: RegionConfig | None = None,
) -> RestingBody:
    """A body with elements of a size [m], held in one of its clamps.

    Args:
        mesh: surface in the unit of the file.
        held: region that a force holds before a release.
    """
    scaled = mesh.copy()
    scaled.apply_scale(settings.unit)
    return RestingBody(
        hexahedra(scaled, size, [clamp.lowest, clamp.highest]),
        Law.from_spec(resting_law(settings.nu)),
        _MODULUS,
        [Clamp(clamp.lowest, clamp.highest)],
        Rotation.from_rotvec(settings.rotation).as_matrix(),
        np.array([settings.hidden.lowest, settings.hidden.highest]),
        SURFACE,
        None if held is None else np.array([held.lowest, held.highest]),
    )


def fit_record(
    mesh: trimesh.Trimesh,
    settings: RestingBodyConfig,
    stills: Sequence[Still],
    poses: Sequence[Array],
    sizes: tuple[float, float],
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fit mu / rho to every still under every clamp, on two meshes.

    Args:
        mesh: surface in the unit of the file.
        poses: of the marker in the camera's frame for the first still, (4, 4) each.
        sizes: largest edges of elements [m], the larger first.

    Returns:
        Plain values: ``clamps``, name -> quantities of `summary`, and ``ratio``, ``log_std`` over all clamps.
    """
    clamps, done, total = {}, 0, 2 * len(settings.clamps) * len(stills)
    for name, clamp in settings.clamps.items():
        fits: list[list[StillFit]] = []
        for size in sizes:
            body, own = resting_body(mesh, settings, clamp, size), []
            for k, still in enumerate(stills):
                before = fits[0][k] if fits else own[0] if own else None
                own.append(
                    fit_still(
                        still,
                        body,
                        [before.pose] if before else poses,
                        np.array(settings.placement),
                        settings.placement_std,
                        before.ratio if before else FIRST_RATIO,
                    )
                )
                done += 1
                if progress:
                    progress(done, total)
            fits.append(own)
        clamps[name] = summary(fits[0], fits[1], sizes[0] / sizes[1])
    return {"clamps": clamps, **over_clamps(clamps)}


def summary(coarse: Sequence[StillFit], fine: Sequence[StillFit], size_ratio: float) -> dict[str, Any]:
    """Plain values of the fits of all stills under one clamp.

    ``ratio`` is mu / rho [m^2/s^2], extrapolated to infinitely small elements, the geometric mean over stills.
    ``log_std`` combines ``noise_std`` of a still, which has placement and pose in it, the scatter ``stills_std``, and
    ``mesh_std``, the extrapolation's whole step. Stills show one state, so that noise is not averaged.
    """
    logs = np.array(
        [
            extrapolated(math.log(a.ratio), math.log(b.ratio), size_ratio)
            for a, b in zip(coarse, fine, strict=True)
        ]
    )
    scatter = float(logs.std(ddof=1)) if len(logs) > 1 else 0.0
    noise = float(np.mean([fit.log_std for fit in fine]))
    step = float(abs(logs.mean() - np.mean([math.log(fit.ratio) for fit in fine])))
    return {
        "ratio": float(np.exp(logs.mean())),
        "log_std": math.hypot(noise, scatter, step),
        "noise_std": noise,
        "stills_std": scatter,
        "mesh_std": step,
        "ratio_by_mesh": [float(np.exp(np.mean(np.log([f.ratio for f in fits])))) for fits in (coarse, fine)],
        **means(fine),
    }


def means(fits: Sequence[StillFit]) -> dict[str, Any]:
    """Agreement of fits with their stills, means over them, pose and placement of each, and the predicted silhouette of
    the first as closed lines of pixels (x, y)."""
    keys = ("contour_rms", "marker_rms", "iou", "cost")
    return {
        **{key: float(np.mean([getattr(fit, key) for fit in fits])) for key in keys},
        "placement": np.mean([fit.placement for fit in fits], axis=0).tolist(),
        "placement_std": np.mean([fit.placement_std for fit in fits], axis=0).tolist(),
        "silhouette": [line.round(1).tolist() for line in contours(fits[0].predicted)],
        "hidden": [line.round(1).tolist() for line in contours(fits[0].hidden)],
        "stills": [
            {"pose": fit.pose.tolist(), "placement": fit.placement.tolist(), "ratio": fit.ratio}
            for fit in fits
        ],
    }


def over_clamps(clamps: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """mu / rho over all clamps, none of which is preferred: geometric mean of the extremes, and a standard deviation of
    half their distance in addition to the largest of one clamp."""
    logs = [math.log(each["ratio"]) for each in clamps.values()]
    half = (max(logs) - min(logs)) / 2
    largest = max(each["log_std"] for each in clamps.values())
    return {
        "ratio": math.exp((max(logs) + min(logs)) / 2),
        "clamp_std": half,
        "log_std": math.hypot(half, largest),
    }


def predict_record(
    mesh: trimesh.Trimesh,
    settings: RestingBodyConfig,
    stills: Sequence[Still],
    poses: Sequence[Array],
    size: float,
    ratios: Mapping[str, float],
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Silhouettes with given mu / rho. Only the camera's pose and the placement are fitted.

    Args:
        ratios: mu / rho [m^2/s^2] by the name of the assumption behind it. Each is combined with each clamp.

    Returns:
        Plain values: ``clamps``, "clamp, assumption" -> agreement.
    """
    clamps, done, total = {}, 0, len(settings.clamps) * len(ratios) * len(stills)
    for name, clamp in settings.clamps.items():
        body = resting_body(mesh, settings, clamp, size)
        for source, ratio in ratios.items():
            fits: list[StillFit] = []
            for still in stills:
                start = [fits[0].pose] if fits else poses
                prior = np.array(settings.placement), settings.placement_std
                fits.append(fit_still(still, body, start, *prior, ratio, fixed_ratio=True))
                done += 1
                if progress:
                    progress(done, total)
            clamps[f"{name}, {source}"] = {"ratio": ratio, **means(fits)}
    return {"clamps": clamps}
