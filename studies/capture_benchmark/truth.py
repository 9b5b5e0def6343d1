"""Ground truth of a demo capture, as plain values."""

from typing import Any

import numpy as np

from studies.capture_benchmark.settings import DemoCapturesConfig
from studies.capture_benchmark.stage import lying, solid, start, time_step, video_cameras


def truth_of(demo: DemoCapturesConfig, name: str, photographs: dict[str, Any]) -> dict[str, Any]:
    """All quantities of an object that the pipeline estimates, in the simulation box [m], y up.

    ``offset_s`` of a camera is the time of its first frame since the start of a drop. ``rotation`` and ``translation``
    of a drop map the photographed object to its pose at this start.

    Args:
        photographs: true cameras of the photographs, by file.
    """
    item = demo.objects[name]
    mesh = solid(item)
    rest = lying(item, mesh)
    drops = {}
    for drop, initial in sorted(item.drops.items()):
        moved = start(item, initial, mesh).after(rest.inverse())
        drops[drop] = {
            **moved.plain(),
            "center_m": moved.apply(rest.apply(np.asarray(mesh.center_mass)[None]))[0].tolist(),
            "v0_m_s": list(initial.velocity),
            "spin_rad_s": list(initial.spin),
        }
    dt = time_step(demo)
    return {
        "shape": item.shape,
        "size_m": item.size,
        "law": item.law.plain(),
        "density": item.density,
        "volume_m3": float(mesh.volume),
        "gravity_m_s2": [0.0, -demo.truth.gravity, 0.0],
        "rate": demo.videos.rate,
        "exposure_s": demo.videos.exposure,
        "held_out": list(item.held_out),
        "lying": rest.plain(),
        "photographs": photographs,
        "cameras": {
            camera: {**eye.plain(), "offset_s": demo.cameras[camera].late * dt}
            for camera, eye in video_cameras(demo).items()
        },
        "drops": drops,
    }
