"""Statistics of a predicted motion that is compared with a video."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from neuma_lib.fitting.frame_batches import first_contact
from neuma_lib.sim.colliders import contact_radius
from neuma_lib.sim.model import MPM, WALLS
from neuma_lib.sim.state import State, Trajectory

FLOOR = "y_min"


def motion_report(
    model: MPM,
    path: Trajectory,
    start: State,
    frames: Sequence[int],
    filmed: Mapping[str, Sequence[int]],
    scale: float = 1.0,
) -> dict[str, Any]:
    """First contact, frames after it, maximum speed, and contacts with walls of the box that the room does not have.

    Args:
        path: the prediction at ``frames``.
        start: its first state.
        frames: simulation steps.
        filmed: steps of the frames of each camera.
        scale: simulated metres per metre of the room.

    Returns:
        ``contact_step`` (None without contact), ``frames_after_contact`` by camera, ``fastest_m_s``, the maximum speed
        of the centre of mass in the room, and ``touched``, names of walls other than the floor.
    """
    first = first_contact(model, path.x, start.vol0, frames)
    contact = frames[first] if first < len(frames) else None
    v = (path.v * (start.mass / start.mass.sum())[:, None]).sum(dim=1)
    low, high = model.free_range
    radius = (contact_radius(start.vol0) if model.contact == "particles" else torch.zeros_like(start.vol0))[
        :, None
    ]
    lowest, highest = (path.x - radius).amin(dim=(0, 1)).tolist(), (path.x + radius).amax(dim=(0, 1)).tolist()
    reached = [
        each for pair in zip((x <= low for x in lowest), (x >= high for x in highest)) for each in pair
    ]
    return {
        "frames": list(frames),
        "contact_step": contact,
        "frames_after_contact": {
            camera: 0 if contact is None else sum(step > contact for step in steps)
            for camera, steps in filmed.items()
        },
        "fastest_m_s": float(v.norm(dim=1).max()) / scale,
        "touched": [wall for wall, hit in zip(WALLS, reached, strict=True) if hit and wall != FLOOR],
    }
