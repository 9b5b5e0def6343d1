"""Frames of a video with the times at which they were taken.

Phones film at a variable rate, and write slow motion at another rate than they film: a frame's time is its time stamp,
never its number over a rate. The ffmpeg that imageio-ffmpeg brings decodes: unlike OpenCV it says of each frame whether
it has a time stamp, in ticks of the file's clock, and what the phone has noted of the rate of filming.
"""

from __future__ import annotations

import re
import subprocess
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

import numpy as np

from neuma_lib.capture.pictures import picture_sheet
from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.io.files import existing, one_line
from neuma_lib.io.images import MAX_PIXELS

MAX_FRAMES = 100_000
"""Most frames of a video that is read: a quarter of an hour at 120 a second."""
STEADY = 0.1
"""Intervals between frames that differ by less than this share count as one rate."""
_SHOWN = re.compile(r"\bn:\s*(\d+)\s+pts:\s*(-?\d+|NOPTS)\s.*\bs:(\d+)x(\d+)\b")
_TIME_BASE = re.compile(r"config in time_base:\s*(\d+)/(\d+)")
_FILMED = re.compile(
    r"^\s*com\.(?:android\.capture\.fps|apple\.quicktime\.capture-?fps)\s*:\s*([\d.]+)", re.MULTILINE
)


@dataclass(frozen=True, eq=False)
class Timeline:
    """When the frames of a video were taken.

    Attributes:
        times: of the frames, ascending, the first as in the file (sound and picture share the clock), (N,) [s].
        width, height: of the upright picture [px].
        stretch: what the file's times were divided by: 8 where 240 frames a second are stored as 30.
    """

    times: np.ndarray
    width: int
    height: int
    stretch: float

    @property
    def rate(self) -> float:
        """Frames a second, of the usual interval."""
        return float(1 / np.median(np.diff(self.times)))

    @property
    def steady(self) -> bool:
        """Whether all intervals are alike."""
        gaps = np.diff(self.times)
        return bool((np.abs(gaps * self.rate - 1) < STEADY).all())

    def plain(self) -> dict[str, Any]:
        """What a report says of it, with all times."""
        return {
            "frames": len(self.times),
            "rate": self.rate,
            "steady": self.steady,
            "lost_before": self.lost.tolist(),
            "stretch": self.stretch,
            "width": self.width,
            "height": self.height,
            "times_s": self.times.tolist(),
        }

    @property
    def lost(self) -> np.ndarray:
        """Numbers of the frames before which at least one is missing."""
        return np.flatnonzero(np.diff(self.times) * self.rate > 1.5) + 1


class Frame(NamedTuple):
    """A frame: its number from 0, its time [s], and its upright RGB picture (H, W, 3), uint8."""

    number: int
    time: float
    pixels: np.ndarray


def read_timeline(path: str | Path, rate: float | None = None) -> Timeline:
    """Times of all frames of a video, all of which are decoded.

    Args:
        path: a file that ffmpeg reads.
        rate: frames a second that were really filmed; None: as the file says, in its time stamps and, for slow motion,
            in what phones note of the rate of filming.

    Raises:
        InputError: no video, fewer than two frames, damaged ones, or times that do not ascend.
    """
    with _decoder(path, pixels=False) as decoder:
        shown = list(decoder.shown())
    if len({(s.width, s.height) for s in shown}) > 1:
        raise InputError(f"{path}: the picture changes its size within the video: film it again, or cut it")
    times = check_times([s.time for s in shown], path)
    usual = float(1 / np.median(np.diff(times)))
    filmed = rate if rate is not None else decoder.filmed_rate()
    # A note of the rate that agrees with the time stamps is less exact than they are.
    stretch = filmed / usual if filmed and (rate is not None or filmed > 1.5 * usual) else 1.0
    return Timeline(times / stretch, shown[0].width, shown[0].height, stretch)


def check_times(times: Sequence[float], path: str | Path) -> np.ndarray:
    """Times (N,) of a video, if they are any.

    Raises:
        InputError: fewer than two, or they do not ascend.
    """
    times = np.asarray(times, np.float64)
    if len(times) < 2:
        raise InputError(f"{path} has {len(times)} frames: at least two are needed, film the whole fall")
    if not np.isfinite(times).all():
        raise InputError(
            f"{path}: frame {np.flatnonzero(~np.isfinite(times))[0]} has no time stamp: {_REWRITE}"
        )
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        i = int(back[0])
        raise InputError(
            f"{path}: the times go back from frame {i} ({times[i]:.4f} s) to frame {i + 1} ({times[i + 1]:.4f} s): "
            + _REWRITE
        )
    return times


_REWRITE = "take the file as the camera wrote it, not one that a program joined or converted"


def read_frames(
    path: str | Path, timeline: Timeline, numbers: Sequence[int] | None = None
) -> Iterator[Frame]:
    """Frames of a video one after the other; no more than one is held.

    Args:
        path: the file of the timeline.
        timeline: of `read_timeline`.
        numbers: frames to give, in ascending order; None gives all.

    Raises:
        InputError: the file is not that of the timeline, or damaged.
    """
    wanted = None if numbers is None else sorted(set(int(n) for n in numbers))
    if wanted is not None and wanted and not 0 <= wanted[0] <= wanted[-1] < len(timeline.times):
        raise InputError(f"{path} has {len(timeline.times)} frames, and no frame {wanted[-1]}")
    if wanted == []:
        return
    size = timeline.width * timeline.height * 3
    given = 0
    with _decoder(path, pixels=True) as decoder:
        for shown in decoder.shown():
            content = decoder.process.stdout.read(size)
            if (shown.width, shown.height) != (timeline.width, timeline.height) or len(content) != size:
                raise InputError(f"{path}: frame {shown.number} is damaged or was changed")
            if wanted is None or shown.number in wanted:
                pixels = np.frombuffer(content, np.uint8).reshape(timeline.height, timeline.width, 3)
                yield Frame(shown.number, float(timeline.times[shown.number]), pixels)
                given += 1
                if wanted is not None and shown.number == wanted[-1]:
                    return
    if given != len(timeline.times if wanted is None else wanted):
        raise InputError(f"{path} has fewer frames than before: it was changed")


def contact_sheet(path: str | Path, frames: Sequence[Frame], title: str, columns: int = 6) -> None:
    """Write a picture with frames in rows, each under its number and time."""
    if not frames:
        raise InputError(f"{path}: there are no frames to show")
    lines = [f"{frame.number}: {frame.time:.4f} s" for frame in frames]
    picture_sheet(path, [(line, frame.pixels) for line, frame in zip(lines, frames)], title, columns)


def sheet_numbers(count: int, most: int = 24) -> list[int]:
    """Numbers of at most ``most`` frames of ``count``, evenly, the first and the last among them."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(most, count))})


class _Shown(NamedTuple):
    number: int
    time: float
    width: int
    height: int


class _Decoder:
    """A running ffmpeg; its messages tell of each frame before its pixels come."""

    def __init__(self, path: Path, process: subprocess.Popen):
        self.path = path
        self.process = process
        self._messages: Queue[str | None] = Queue()
        self._heard: list[str] = []
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for line in self.process.stderr:
            self._messages.put(line.decode(errors="replace").rstrip())
        self._messages.put(None)

    def shown(self) -> Iterator[_Shown]:
        """The frames in the order of their output."""
        count, tick = 0, np.nan
        while (message := self._messages.get()) is not None:
            if "Parsed_showinfo" not in message:
                self._heard.append(message)
                continue
            if found := _TIME_BASE.search(message):
                tick = int(found[1]) / int(found[2])
            elif found := _SHOWN.search(message):
                number, width, height = int(found[1]), int(found[3]), int(found[4])
                if width * height > MAX_PIXELS or number >= MAX_FRAMES:
                    raise InputError(
                        f"{self.path}: {width} x {height} pixels, frame {number}: at most {MAX_PIXELS} pixels and "
                        f"{MAX_FRAMES} frames are read; cut the video to the throw"
                    )
                count += 1
                # not pts_time, which has six digits only
                yield _Shown(number, int(found[2]) * tick if found[2] != "NOPTS" else np.nan, width, height)
        if self.process.wait() or count == 0:
            reasons = [m for m in self._heard if "rror" in m or "nvalid" in m or "no streams" in m]
            reason = one_line(reasons[-1]) if reasons else "it has no frames"
            raise InputError(
                f"{self.path} cannot be read as a video ({reason}): copy it from the camera again, or leave it out"
            )

    def filmed_rate(self) -> float | None:
        """Frames a second that were filmed, if the file notes them."""
        found = _FILMED.search("\n".join(self._heard))
        return float(found[1]) if found and float(found[1]) > 0 else None


@contextmanager
def _decoder(path: str | Path, pixels: bool) -> Iterator[_Decoder]:
    path = existing(path, "put the video there, or correct its name")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty: copy it from the camera again")
    output = ["-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"] if pixels else ["-f", "null", "-"]
    # A file's name must not be taken for a protocol's; V leaves out cover pictures; pictures are upright before they
    # come to a filter.
    command = [
        require("imageio_ffmpeg", "capture").get_ffmpeg_exe(),
        "-hide_banner",
        "-nostdin",
        "-xerror",
        "-protocol_whitelist",
        "file",
    ]
    command += ["-i", f"file:{path.resolve()}", "-map", "0:V:0", "-vf", "showinfo=checksum=0"]
    command += ["-fps_mode", "passthrough", "-threads", "1", *output]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE if pixels else subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    try:
        yield _Decoder(path, process)
    finally:
        process.kill()
        process.wait()
        if process.stdout:
            process.stdout.close()
