"""Free flight in one video of a fixed camera of which nothing is known but how wide the object is.

    python -m benchmarks.clip VIDEO OUT --diameter 0.067          # a tennis ball; pictures go to OUT

Times, masks and the parabola are found as for a capture (`neuma_lib.capture`), without a picture of the empty scene:
the median of the frames stands in for it. The camera is taken to be level and to look across the flight, and metres
come from the object's width in the picture where it is slowest. Says how many frames show the object and what gravity
is; with the width unknown (`--diameter` left out) it says how wide an object would be that falls with 9.81 m/s^2.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from neuma_lib.capture.frames import contact_sheet, read_frames, read_timeline, sheet_numbers
from neuma_lib.capture.free_fall import Track, fit_flight
from neuma_lib.capture.masks import overlay
from neuma_lib.capture.video_masks import video_masks
from neuma_lib.config.simulation import GRAVITY

DOWN = np.array([0.0, 1.0])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("video", type=Path, help="of a fixed camera")
    parser.add_argument("out", type=Path, help="folder of the pictures")
    parser.add_argument("--diameter", type=float, help="how wide the object is [m]")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    name = args.video.name
    begun = time.process_time()
    timeline = read_timeline(args.video)
    frames = list(read_frames(args.video, timeline))
    pixels = [frame.pixels for frame in frames]
    found = video_masks(pixels, name, times=timeline.times, down=DOWN)
    there = np.flatnonzero(found.masks.any(axis=(1, 2)))
    print(
        f"{name}: {len(frames)} frames of {timeline.width}x{timeline.height}, {timeline.rate:.2f} a second;"
        f" {len(there)} show the object, flights in frames"
        f" {', '.join(f'{a.frames[0]} to {a.frames[1]}' for a in found.arcs) or 'none'};"
        f" {time.process_time() - begun:.0f} s of a core"
    )
    pictures = [overlay(frames[i], found.masks[i]) for i in there[sheet_numbers(len(there))]]
    contact_sheet(args.out / f"{args.video.stem}.png", pictures, name)
    for arc in found.arcs:
        flying = slice(arc.frames[0], arc.frames[1] + 1)
        radius = _radius(found.masks[flying], found.centroids[flying])
        track = _track(
            found.centroids[flying], timeline.times[flying], radius, args.diameter or 1.0, pixels[0], name
        )
        fall, (kept,) = fit_flight([track], (np.zeros(3), np.array([0.0, 0.0, 1.0])))
        (ratio, deviation), (angle, _) = fall.gravity.ratio, fall.gravity.angle()
        said = f"frames {arc.frames[0] + kept.start} to {arc.frames[0] + kept.stop - 1}: {2 * radius:.1f} px wide"
        if args.diameter:
            print(f"{said}; {fall.gravity.told(name)}")
        else:
            print(
                f"{said}; gravity {angle:.1f} degrees from straight down in the picture; {1e3 / ratio:.0f} +-"
                f" {1e3 * deviation / ratio**2:.0f} mm wide if it falls with {GRAVITY} m/s^2"
            )


def _radius(masks: np.ndarray, places: np.ndarray) -> float:
    """Half the width of the masks across their longer axis, where the object is slowest and least blurred [px]."""
    speeds = np.linalg.norm(np.gradient(places, axis=0), axis=1)
    slowest = np.argsort(speeds)[: max(3, len(speeds) // 4)]
    # An ellipse with half an axis r has the variance r^2 / 4 along it.
    variances = [np.linalg.eigvalsh(np.cov(np.argwhere(masks[i]).T))[0] for i in slowest]
    return 2 * float(np.sqrt(np.median(variances)))


def _track(
    places: np.ndarray, times: np.ndarray, radius: float, diameter: float, picture: np.ndarray, name: str
) -> Track:
    """As seen by a level camera in whose picture an object in the plane z = 0 is as wide as it is."""
    height, width = picture.shape[:2]
    focal = 1.2 * width  # cancels, but for what perspective does to an object that leaves the plane
    distance = focal * diameter / (2 * radius)
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0])
    viewmat[2, 3] = distance
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Track(times, places, viewmat, K, name, radius)


if __name__ == "__main__":
    main()
