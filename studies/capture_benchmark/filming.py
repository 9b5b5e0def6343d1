"""Photographs and videos of the demo captures: renders of Blender with a camera's exposure and noise."""

import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from neuma_lib.data.blender.scene import Progress
from neuma_lib.extras import require
from neuma_lib.io.files import atomic
from studies.capture_benchmark.furniture import RULER, furniture
from studies.capture_benchmark.pictures import dead_leaves, ruler_picture
from studies.capture_benchmark.room import Moving, Scenery, Shot, shoot
from studies.capture_benchmark.settings import DemoCapturesConfig, DemoObjectConfig, DemoRoomConfig
from studies.capture_benchmark.stage import MIDDLE, Eye, lens_row, video_cameras

PAPER = 0.0004  # height of the page above the floor, which separates the two surfaces [m]
MARGIN = 10  # margin of the rendered regions around the body and its shadow [px]
START = 15_000
"""Overhead of a rendered region, in pixels. Two regions are merged if that is cheaper."""
EVERY = 5
"""Stride of the vertices that bound the body. Vertices are some millimetres apart."""
RIM = 8  # points of a lamp's rim from which shadows are cast
WALL_TEXEL = 2.0  # side of a wall's pixels, in pixels of the floor


def scenery(
    room: DemoRoomConfig, page: np.ndarray, size: tuple[float, float], item: DemoObjectConfig
) -> Scenery:
    """The room of an object with textures and lamps, from the printed page, sRGB (H, W, 3), uint8, and its size [m]."""
    half, wall = room.half, room.wall
    texel = 2 * half / room.texels
    corners = [np.array([[-half, 0, -half], [half, 0, -half], [half, 0, half], [-half, 0, half]])]
    pictures = [dead_leaves(2 * half, 2 * half, texel, room.seed)]
    if not item.difficulties.board:
        page, size = ruler_picture(*RULER), (RULER[0], RULER[1])
    wide, deep = np.array([size[0] / 2, 0, 0]), np.array([0, 0, size[1] / 2])
    middle = np.array(room.page) + [0, PAPER, 0]
    corners.append(
        np.stack([middle - wide - deep, middle + wide - deep, middle + wide + deep, middle - wide + deep])
    )
    pictures.append(page)
    for number, (x, z) in enumerate(((0, -1), (1, 0), (0, 1), (-1, 0))):
        to, along = half * np.array([x, 0.0, z]), half * np.array([-z, 0.0, x])
        up = np.array([0.0, wall, 0.0])
        corners.append(np.stack([to - along + up, to + along + up, to + along, to - along]))
        pictures.append(dead_leaves(2 * half, wall, WALL_TEXEL * texel, room.seed + 1 + number))
    for sides, textures in furniture(room, item):
        corners += sides
        pictures += textures
    return Scenery(
        corners=np.stack(corners) + MIDDLE,
        pictures=pictures,
        lamps=np.array(room.lamps) + MIDDLE,
        lamp_size=room.lamp_size,
        lamp_target=MIDDLE,
        power=room.power,
        ambient=room.ambient,
        bounces=room.bounces,
    )


def photograph(
    demo: DemoCapturesConfig,
    where: Scenery,
    body: Moving,
    eyes: Sequence[Eye],
    threads: int,
    progress: Progress | None,
) -> Iterator[tuple[np.ndarray, float]]:
    """Photographs (H, W, 3), uint8, of the body's first frame, each with its relative exposure."""
    rng = np.random.default_rng([demo.seed, 1, len(eyes)])
    settings = demo.photographs
    (item,) = demo.objects.values()
    shots = [Shot(eye.c2w, lens_row(eye.lens), 0) for eye in eyes]
    lights = 1 + settings.exposure * rng.uniform(-1, 1, len(eyes))
    rendered = shoot(where, body, shots, samples=settings.samples, threads=threads, progress=progress)
    for light, pixels in zip(lights, rendered):
        blurred = shaken(pixels, item.difficulties.blur * demo.resolution, rng)
        yield developed(light * blurred, settings.noise, rng), float(light)


def backgrounds(
    demo: DemoCapturesConfig, where: Scenery, threads: int, progress: Progress | None
) -> dict[str, np.ndarray]:
    """The empty room in each video camera, linear (H, W, 3), float32."""
    eyes, samples = video_cameras(demo), demo.videos.plate_samples
    shots = [Shot(eye.c2w, lens_row(eye.lens), -1) for eye in eyes.values()]
    return dict(zip(eyes, shoot(where, None, shots, samples=samples, threads=threads, progress=progress)))


def film(
    demo: DemoCapturesConfig,
    where: Scenery,
    body: Moving,
    frames: dict[str, np.ndarray],
    empty: dict[str, np.ndarray],
    seed: Sequence[int],
    threads: int,
    progress: Progress | None,
    bystander: Moving | None = None,
) -> dict[str, list[np.ndarray]]:
    """Frames (H, W, 3), uint8, of each camera.

    Only the regions of the bodies and their shadows are rendered. The rest is the empty scene.

    Args:
        body: at all frames of all cameras.
        frames: numbers of the body's frames for each camera.
        empty: of `backgrounds`.
        seed: of noise.
        bystander: another body in motion, at the same frames.
    """
    eyes, exposure, rng = video_cameras(demo), demo.videos.exposure, np.random.default_rng(seed)
    (item,) = demo.objects.values()
    trouble, others = item.difficulties, [bystander] if bystander else []
    shots: list[list[Shot]] = []
    for name, eye in eyes.items():
        reach = 0.5 * (exposure + trouble.row_time * eye.lens.height)
        for frame in frames[name]:
            parts = []
            for each in (body, *others):
                moved = reach * each.velocities[frame, ::EVERY]
                swept = np.concatenate([each.vertices[frame, ::EVERY] + side * moved for side in (-1, 1)])
                parts += regions(eye, swept, where.lamps, where.lamp_size)
            shots.append([Shot(eye.c2w, lens_row(eye.lens), int(frame), part) for part in parts])
    rendered = shoot(
        where,
        together(body, *others),
        [shot for parts in shots for shot in parts],
        samples=demo.videos.samples,
        exposure=exposure,
        row_time=trouble.row_time,
        threads=threads,
        progress=progress,
    )
    order, pictures = iter(shots), {}
    for name in eyes:
        pictures[name] = []
        paths = hand_path(len(frames[name]), trouble.sway, rng)
        for shift in paths:
            picture = empty[name].copy()
            for shot in next(order):
                x0, y0, x1, y1 = shot.region
                picture[y0:y1, x0:x1] = next(rendered)
            if trouble.sway:
                picture = ndimage.shift(picture, (*shift, 0), order=1, mode="nearest")
            pictures[name].append(developed(picture, demo.videos.noise, rng))
    return pictures


def shaken(linear: np.ndarray, blur: float, rng: np.random.Generator) -> np.ndarray:
    """A photograph (H, W, 3) blurred along a straight line, as by a turn of the hand.

    Args:
        linear: radiance.
        blur: standard deviation of the length of the line [px].
    """
    if not blur:
        return linear
    length, turn = abs(rng.normal(0, blur)), rng.uniform(0, np.pi)
    half = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * half + 1,) * 2)
    for along in np.linspace(-length / 2, length / 2, 41):
        row, column = half + along * np.sin(turn), half + along * np.cos(turn)
        y, x = int(row), int(column)
        for dy, dx in np.ndindex(2, 2):
            kernel[y + dy, x + dx] += (1 - abs(row - y - dy)) * (1 - abs(column - x - dx)) / 41
    return ndimage.convolve(linear, kernel[..., None].astype(np.float32), mode="nearest")


def hand_path(count: int, sway: float, rng: np.random.Generator) -> np.ndarray:
    """Shifts (T, 2) [px] of a hand-held camera, a smooth random motion with this standard deviation."""
    if not sway:
        return np.zeros((count, 2))
    steps = ndimage.gaussian_filter1d(rng.normal(size=(count, 2)), 6, axis=0, mode="wrap")
    return sway * (steps - steps[0]) / steps.std()


def together(*bodies: Moving) -> Moving:
    """One mesh of bodies at the same frames."""
    if len(bodies) == 1:
        return bodies[0]
    counts = np.cumsum([0] + [body.vertices.shape[1] for body in bodies[:-1]])
    return Moving(
        np.concatenate([body.vertices for body in bodies], axis=1),
        np.concatenate([body.velocities for body in bodies], axis=1),
        np.concatenate([body.faces + count for body, count in zip(bodies, counts)]),
        np.concatenate([body.colors for body in bodies]),
    )


def regions(
    eye: Eye, points: np.ndarray, lamps: np.ndarray, lamp_size: float
) -> list[tuple[int, int, int, int]]:
    """Regions of a picture that contain a body and its shadow on the floor: x0, y0, x1, y1 [px].

    Args:
        points: of the body's surface [m], (N, 3).
        lamps: centres of lamps above all points [m], (L, 3).
        lamp_size: their diameter [m].
    """
    angles = 2 * np.pi * np.arange(RIM) / RIM
    rim = lamp_size / 2 * np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    sources = (lamps[:, None] + rim).reshape(-1, 1, 3)
    shadows = sources + (points - sources) * (sources[..., 1:2] / (sources[..., 1:2] - points[:, 1:2]))
    boxes = [_box(eye, points), _box(eye, shadows.reshape(-1, 3))]
    boxes = [box for box in boxes if box is not None]
    if len(boxes) == 2:
        a, b = boxes
        both = (min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3]))
        if _area(both) < _area(a) + _area(b) + START:
            return [both]
    return boxes


def _box(eye: Eye, points: np.ndarray) -> tuple[int, int, int, int] | None:
    before = (points - eye.c2w[:3, 3]) @ eye.c2w[:3, 2] < -0.05
    pixels = eye.project(points[before])
    size = np.array([eye.lens.width, eye.lens.height])
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - MARGIN, 0, size)
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + MARGIN, 0, size)
    return (*low.tolist(), *high.tolist()) if (high > low).all() else None


def _area(box: tuple[int, int, int, int]) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


def developed(linear: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Convert radiance to a camera's picture, sRGB (H, W, 3), uint8, with noise.

    Args:
        linear: radiance, 1 is white.
        noise: standard deviation of a pixel's noise [1/255].
    """
    light = np.clip(linear, 0.0, 1.0)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.clip(np.rint(255 * srgb + rng.normal(0, noise, srgb.shape)), 0, 255).astype(np.uint8)


def write_jpeg(path: str | Path, pixels: np.ndarray, quality: int) -> None:
    with atomic(path) as partial:
        Image.fromarray(pixels).save(partial, "JPEG", quality=quality, subsampling=0)


def write_video(path: str | Path, pictures: Sequence[np.ndarray], rate: int, quality: int) -> None:
    """Write an H.264 file without sound from pictures (H, W, 3), uint8, of even size."""
    height, width = pictures[0].shape[:2]
    with atomic(path) as partial:
        source = f"-y -v error -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate} -i -"
        target = f"-c:v libx264 -crf {quality} -pix_fmt yuv420p -threads 1 -f mp4"
        ffmpeg = require("imageio_ffmpeg", "capture").get_ffmpeg_exe()
        command = [ffmpeg, *source.split(), *target.split(), str(partial)]
        subprocess.run(command, input=np.stack(pictures).tobytes(), check=True)
