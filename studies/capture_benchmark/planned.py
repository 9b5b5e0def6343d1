"""Settings and file lists of the demo captures, known before their files exist."""

from pathlib import Path
from typing import Any

from neuma_lib.config.capture import CaptureConfig
from neuma_lib.config.validation import validate
from neuma_lib.project.capture_folder import Capture
from studies.capture_benchmark.settings import DemoCapturesConfig

PREFIX = "demo_"


def planned_captures(demo: DemoCapturesConfig, root: str | Path) -> dict[str, Capture]:
    """Settings and files of the demo captures, by name, in the folder of all captures."""
    captures = {}
    for name, item in demo.objects.items():
        folder = Path(root) / f"{PREFIX}{name}"
        captures[folder.name] = Capture(
            folder,
            validate(CaptureConfig, capture_settings(demo, name)),
            tuple(folder / "photos" / file for file in photograph_files(demo)),
            {camera: folder / f"stills/{camera}.png" for camera in sorted(demo.cameras)},
            {
                drop: {camera: folder / f"videos/{drop}/{camera}.mp4" for camera in sorted(demo.cameras)}
                for drop in sorted(item.drops)
            },
        )
    return captures


def photograph_files(demo: DemoCapturesConfig) -> list[str]:
    """Names of the photographs of each object, in order."""
    count = demo.photographs.count(len(demo.cameras)) if demo.photographs else 0
    return [f"{number:03}.jpg" for number in range(count)]


def capture_settings(demo: DemoCapturesConfig, name: str) -> dict[str, Any]:
    """The capture.yaml of an object: measured inputs only, no ground truth."""
    item, board, (x, _, z) = demo.objects[name], demo.room.board, demo.room.page
    columns, rows = board.squares
    printed = {
        "board": board.model_dump(mode="json", exclude_defaults=True),
        # Point above which objects fall, from the lower left corner of the squares, rounded like a measurement.
        "center": [round(board.square * columns / 2 - x, 4), round(board.square * rows / 2 + z, 4)],
    }
    return {
        **(printed if item.difficulties.board else {}),
        "cameras": {camera: {"exposure": demo.videos.exposure} for camera in sorted(demo.cameras)},
        "prior": item.prior,
        "density": item.density,
        "held_out": list(item.held_out),
    }
