"""Write a synthetic scene for other systems, in the layouts that `released` and `layouts` read.

A folder for each scene has the images, the cameras, ``scene.json`` (times, density, gravity) and ``starts.ply``, the
points whose motion is scored. The folder ``truth`` next to them has what a method must not read: the motion of these
points and of another sampling of the body, and the true law. Images are copied byte by byte. The world is ours: metres,
y up, the ground at y = 0, in the unit cube.

=============  =====================================  ====================================================
layout         video                                  photographs of the body at the first frame
=============  =====================================  ====================================================
neuma          ``data_dynamic.json``, data_dynamic/   ``data_static.json``, data_static/
pac_nerf       ``all_data.json``, data/               static/, ``transforms.json`` (of nerfstudio)
spring_gaus    ``camera.json``, a folder each camera  as pac_nerf
=============  =====================================  ====================================================
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.datasets.layouts import BACKGROUND
from neuma_lib.io.files import atomic, write_json, write_text
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import image_file, read_image_set, read_transforms, write_transforms
from neuma_lib.io.positions import write_points

PARTS = ("static", "dynamic")
TRUTH = "truth"  # folder of what a method must not read
MOTION = ("tracers", "tracers_again", "frames", "time")
LICENSE = """\
The images, cameras and motions in this folder were generated with the software "NeuMA, done right" and are licensed
under Creative Commons Attribution 4.0 International, https://creativecommons.org/licenses/by/4.0/. Attribution: cite
the software and the paper whose method it implements, see its CITATION.cff. Everything is provided as is, without
warranty. The licence of the software is MIT.
"""


@dataclass(frozen=True, eq=False)
class _Picture:
    """An image of a scene."""

    file: Path  # to copy
    pixels: np.ndarray  # straight-alpha RGBA, uint8, shape (H, W, 4)
    pose: list[list[float]]  # camera to world, OpenGL axes, 4 x 4
    intrinsics: list[list[float]]  # [px], 3 x 3
    # view, step: numbers of the camera and of the simulation step
    view: int
    step: int

    def camera(self, key: str = "intrinsic") -> dict[str, Any]:
        return {"c2w": self.pose, key: self.intrinsics}

    def copy(self, target: Path) -> None:
        with atomic(target) as partial:
            shutil.copyfile(self.file, partial)


def write_scene(
    layout: str, source: str | Path, out: str | Path, name: str, about: Mapping[str, Any]
) -> None:
    """Write a scene to ``out/name``, its truth to ``out/truth``, and the licence of both to ``out``.

    Args:
        layout: one of `LAYOUTS`.
        source: folder of the scene's data, with ``static``, ``dynamic`` and ``truth.h5``.
        about: content of ``scene.json`` in addition to layout, frames and times.

    Raises:
        InputError: missing or damaged files, frames that are not evenly spaced, or ``out/name`` exists.
    """
    source, folder = Path(source), Path(out, name)
    if folder.exists():
        raise InputError(folder, "exists already", "Choose another --out, or delete it")
    static, dynamic = (source / part / "transforms.json" for part in PARTS)
    motion, attributes = read_arrays(source / "truth.h5", required=MOTION, only=MOTION)
    photographs, video = _pictures(static), _pictures(dynamic)
    LAYOUTS[layout](folder, video, photographs, motion["time"])
    write_points(folder / "starts.ply", motion["tracers"][0])
    known = {"layout": layout, "frames": motion["frames"].tolist(), "time": motion["time"].tolist()}
    write_json(folder / "scene.json", {"scene": name, **known, **about})
    write_arrays(Path(out, TRUTH, f"{name}.h5"), motion, {"scene": name, **attributes})
    write_text(Path(out, "LICENSE"), LICENSE)


def frame_numbers(steps: Sequence[int]) -> dict[int, int]:
    """Number of each frame in layouts that count frames, or InputError unless they are evenly spaced from step 0."""
    steps = sorted({int(step) for step in steps})
    stride = steps[1] if len(steps) > 1 else 1
    if steps != [stride * number for number in range(len(steps))]:
        problem = f"{steps} must be evenly spaced from step 0, because this layout counts frames"
        raise InputError("frames", problem, "Use --layout neuma")
    return {step: number for number, step in enumerate(steps)}


def _pictures(listed: Path) -> list[_Picture]:
    """The images of a transforms.json, checked."""
    images, frames = read_image_set(listed), read_transforms(listed)["frames"]
    files = [image_file(listed.parent, frame["file_path"], listed) for frame in frames]
    poses = [frame["transform_matrix"] for frame in frames]
    known = images.images, poses, images.Ks.tolist(), images.views.tolist(), images.steps.tolist()
    return [_Picture(*each) for each in zip(files, *known, strict=True)]


def _write_neuma(
    folder: Path, video: Sequence[_Picture], photographs: Sequence[_Picture], time: np.ndarray
) -> None:
    for part, pictures in zip(PARTS, (photographs, video), strict=True):
        entries = []
        for each in pictures:
            name = f"./data_{part}/d_{each.view}_{each.step:03d}.png"
            each.copy(folder / name)
            entries.append({"file_path": name, **each.camera()})
        write_json(folder / f"data_{part}.json", entries)


def _write_pac_nerf(
    folder: Path, video: Sequence[_Picture], photographs: Sequence[_Picture], time: np.ndarray
) -> None:
    """Their code requires poses (3, 4), and ignores alpha: it compares colours with the background."""
    numbers, entries = frame_numbers([each.step for each in video]), []
    backgrounds: dict[int, np.ndarray] = {}
    for each in video:
        number, camera = numbers[each.step], {**each.camera(), "c2w": each.pose[:3]}
        name = f"./data/r_{each.view}_{number}.png"
        each.copy(folder / name)
        entries.append({"file_path": name, "time": float(time[number]), **camera})
        colours, alpha = each.pixels[..., :3], each.pixels[..., 3:]
        matte = colours * (alpha / 255) + (255 - alpha)
        _save(folder / f"data/m_{each.view}_{number}.png", matte)
        if each.view not in backgrounds:
            backgrounds[each.view] = np.zeros_like(colours)
            entries.append({"file_path": f"./data/r_{each.view}_{BACKGROUND}.png", **camera})
        np.copyto(backgrounds[each.view], colours, where=alpha == 0)
    for view, pixels in backgrounds.items():
        _save(folder / f"data/r_{view}_{BACKGROUND}.png", pixels)
    write_json(folder / "all_data.json", entries)
    _write_photographs(folder, photographs)


def _write_spring_gaus(
    folder: Path, video: Sequence[_Picture], photographs: Sequence[_Picture], time: np.ndarray
) -> None:
    numbers, cameras = frame_numbers([each.step for each in video]), {}
    for each in video:
        name = f"camera_{each.view:02d}"
        each.copy(folder / name / f"{numbers[each.step]:03d}.png")
        cameras[each.view] = {"camera": name, **each.camera("K")}
    write_json(folder / "camera.json", [cameras[view] for view in sorted(cameras)])
    _write_photographs(folder, photographs)


LAYOUTS = {"neuma": _write_neuma, "pac_nerf": _write_pac_nerf, "spring_gaus": _write_spring_gaus}


def _write_photographs(folder: Path, photographs: Sequence[_Picture]) -> None:
    """The photographs in the format of nerfstudio, because these layouts have none."""
    frames = []
    for each in photographs:
        name = f"r_{each.view}_{each.step}.png"
        each.copy(folder / "static" / name)
        (fx, _, cx), (_, fy, cy), _ = each.intrinsics
        height, width = each.pixels.shape[:2]
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height}
        numbers = {"view": each.view, "step": each.step}
        frames.append({"file_path": name, "transform_matrix": each.pose, **numbers, **lens})
    write_transforms(folder / "static/transforms.json", {}, frames)


def _save(path: Path, pixels: np.ndarray) -> None:
    with atomic(path) as partial:
        Image.fromarray(pixels.round().astype(np.uint8)).save(partial, "PNG")
