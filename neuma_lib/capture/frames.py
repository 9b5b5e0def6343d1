"""Frames of a video with their capture times.

Phones record at a variable rate and store slow motion at another rate, so the time of a frame is its time stamp, not
its number divided by a rate. Some store the same picture several times, as 30 per second in a file of 60. A repeated
picture has a wrong time, so it is detected and left out. Videos are decoded with the ffmpeg of imageio-ffmpeg. Unlike
OpenCV, it reports whether a frame has a time stamp, in ticks of the file's clock, and the recording rate noted by the
phone.
"""

import re
import subprocess
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

import numpy as np

from neuma_lib.capture.pictures import picture_sheet
from neuma_lib.capture.tools import ffmpeg_input
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, one_line
from neuma_lib.io.images import MAX_PIXELS
from neuma_lib.io.processes import start_child

MAX_FRAMES = 100_000  # frames of a video that are accepted: a quarter of an hour at 120 per second
STEADY = 0.1  # relative variation of the frame interval below which the rate is considered constant
_REPEATED = 0.3  # change of a repeated picture relative to those before and after it
_MIN_PERIODIC, _PERIODIC = 5, 0.6  # repeats, and share of them, that determine a period
_MAX_REPEATS = 4  # of one picture
_FRAME_INFO = re.compile(r"\bn:\s*(\d+)\s+pts:\s*(-?\d+|NOPTS)\s.*\bs:(\d+)x(\d+)\b")
_TIME_BASE = re.compile(r"config in time_base:\s*(\d+)/(\d+)")
_NOTED_RATE = re.compile(
    r"^\s*com\.(?:android\.capture\.fps|apple\.quicktime\.capture-?fps)\s*:\s*([\d.]+)", re.MULTILINE
)


@dataclass(frozen=True, eq=False)
class Timeline:
    """Capture times of the frames of a video."""

    times: np.ndarray  # ascending, the first as in the file (sound and picture share the clock), (N,) [s]
    # width, height: of the upright picture [px]
    width: int
    height: int
    stretch: float  # divisor of the file's times: 8 if 240 frames per second are stored as 30
    # numbers of the frames that show the picture of the previous frame again, (R,)
    repeated: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    @property
    def numbers(self) -> np.ndarray:
        """Numbers of the frames that are not repeated, (K,)."""
        return np.setdiff1d(np.arange(len(self.times)), self.repeated)

    @property
    def rate(self) -> float:
        """Different pictures per second, from the median interval."""
        return float(1 / np.median(np.diff(self.times[self.numbers])))

    @property
    def steady(self) -> bool:
        """Whether the rate is constant."""
        gaps = np.diff(self.times[self.numbers])
        return bool((np.abs(gaps * self.rate - 1) < STEADY).all())

    def plain(self) -> dict[str, Any]:
        """Entries of a report."""
        return {
            "frames": len(self.times),
            "rate": self.rate,
            "steady": self.steady,
            "lost_before": self.lost.tolist(),
            "repeated": self.repeated.tolist(),
            "stretch": self.stretch,
            "width": self.width,
            "height": self.height,
            "times_s": self.times.tolist(),
        }

    @property
    def lost(self) -> np.ndarray:
        """Numbers of the frames with at least one missing frame before them."""
        return self.numbers[1:][np.diff(self.times[self.numbers]) * self.rate > 1.5]


class Frame(NamedTuple):
    """A frame: its number from 0, its time [s], and its upright RGB picture (H, W, 3), uint8."""

    number: int
    time: float
    pixels: np.ndarray


def read_timeline(path: str | Path, rate: float | None = None) -> Timeline:
    """Times of all frames of a video, which is decoded completely.

    Args:
        path: a file that ffmpeg reads.
        rate: true recording rate [frames per second]. None: from the time stamps and, for slow motion, from the
            recording rate noted by the phone.

    Raises:
        InputError: no video, fewer than two frames, damaged frames, or times that do not ascend.
    """
    with _decoder(path, pixels=False) as decoder:
        infos = list(decoder.infos())
        repeated = repeated_frames(decoder.changes())
    if len({(info.width, info.height) for info in infos}) > 1:
        raise InputError(path, "the picture size changes within the video", "Film it again, or cut it")
    times = check_times([info.time for info in infos], path)
    usual = float(1 / np.median(np.diff(times)))
    filmed = rate if rate is not None else decoder.noted_rate()
    # Time stamps are more accurate than a noted rate that agrees with them.
    stretch = filmed / usual if filmed and (rate is not None or filmed > 1.5 * usual) else 1.0
    return Timeline(times / stretch, infos[0].width, infos[0].height, stretch, repeated)


def timeline_of(report: Mapping[str, Any]) -> Timeline:
    """The timeline of a report, see `Timeline.plain`."""
    times, repeated = np.array(report["times_s"], float), np.array(report["repeated"], int)
    return Timeline(times, report["width"], report["height"], report["stretch"], repeated)


def repeated_frames(changes: np.ndarray) -> np.ndarray:
    """Numbers of the frames that repeat the previous picture.

    A repeated picture differs far less than its neighbours, by compression alone, everywhere in the picture.
    Compression also repeats the background of new pictures, so the mean difference alone is not sufficient. In a scene
    at rest all frames may be equal, and none is reported, unless repeats in motion have a period.

    Args:
        changes: mean and maximum absolute difference of each frame but the first from the previous one, (N - 1, 2).
    """
    padded = np.pad(changes, ((1, 1), (0, 0)), constant_values=np.nan)
    inner, ends = [], []
    k = 1
    while k <= len(changes):
        # The longest run of small changes from k on, compared with the changes on both sides of it.
        for end in range(min(k + _MAX_REPEATS, len(changes) + 1), k, -1):
            sides = padded[[k - 1, end]]
            limit = np.nanmin(sides, axis=0, initial=np.inf)
            if (padded[k:end] < _REPEATED * limit).all() and np.isfinite(limit).all():
                (ends if np.isnan(sides).any() else inner).extend(range(k, end))
                break
        else:
            end = k + 1
        k = end
    # At an end of the video, rest looks the same, so others must repeat, too.
    repeated = np.array(sorted(inner + ends) if len(inner) > 2 else inner, int)
    if len(repeated) < _MIN_PERIODIC:
        return repeated
    steps = np.diff(repeated)
    period = int(np.bincount(steps).argmax())
    phase = int(np.bincount(repeated % period).argmax())
    if period > 1 and min((steps == period).mean(), (repeated % period == phase).mean()) > _PERIODIC:
        mean = padded[:, 0]
        others = np.arange(phase or period, len(changes), period)
        others = others[mean[others] < np.fmin(mean[others - 1], mean[others + 1])]
        repeated = np.union1d(repeated, others)
    return repeated


def check_times(times: Sequence[float], path: str | Path) -> np.ndarray:
    """Times (N,) of a video as an array. Raises InputError for fewer than two, a missing one, or wrong order."""
    times = np.asarray(times, np.float64)
    if len(times) < 2:
        raise InputError(path, f"{len(times)} frames, at least two are required", "Film the whole fall")
    if not np.isfinite(times).all():
        raise InputError(path, f"frame {np.flatnonzero(~np.isfinite(times))[0]} has no time stamp", _ORIGINAL)
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        i = int(back[0])
        problem = f"times decrease from frame {i} ({times[i]:.4f} s) to frame {i + 1} ({times[i + 1]:.4f} s)"
        raise InputError(path, problem, _ORIGINAL)
    return times


_ORIGINAL = "Use the original file of the camera, not one that was joined or converted"


def read_frames(
    path: str | Path, timeline: Timeline, numbers: Sequence[int] | None = None
) -> Iterator[Frame]:
    """Iterate over frames of a video, with one frame in memory at a time.

    Args:
        path: the file of the timeline.
        timeline: of `read_timeline`.
        numbers: frames to yield, in ascending order. None yields all that are not repeated.

    Raises:
        InputError: the file does not match the timeline, or is damaged.
    """
    wanted = {int(n) for n in (timeline.numbers if numbers is None else numbers)}
    if wanted and not 0 <= min(wanted) <= max(wanted) < len(timeline.times):
        raise InputError(path, f"no frame {max(wanted)}, the video has {len(timeline.times)} frames")
    if not wanted:
        return
    size = timeline.width * timeline.height * 3
    with _decoder(path, pixels=True) as decoder:
        for info in decoder.infos():
            content = decoder.process.stdout.read(size)
            if (info.width, info.height) != (timeline.width, timeline.height) or len(content) != size:
                raise InputError(path, f"frame {info.number} is damaged, or the file has changed", _AGAIN)
            if info.number in wanted:
                wanted.remove(info.number)
                pixels = np.frombuffer(content, np.uint8).reshape(timeline.height, timeline.width, 3)
                yield Frame(info.number, float(timeline.times[info.number]), pixels)
                if not wanted:
                    return
    raise InputError(path, "it has fewer frames than before, so the file has changed", _AGAIN)


class StoredPictures(Sequence[np.ndarray]):
    """Pictures of one size (H, W, 3), uint8, in a temporary file, so that memory holds only those in use."""

    def __init__(self, pictures: Iterable[np.ndarray]):
        self._file = tempfile.TemporaryFile()
        self._count, self.shape = 0, (0, 0, 3)
        for picture in pictures:
            self.shape = picture.shape
            self._file.write(np.ascontiguousarray(picture).data)
            self._count += 1

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, i: int) -> np.ndarray:
        if not 0 <= i < self._count:
            raise IndexError(i)
        size = int(np.prod(self.shape))
        self._file.seek(int(i) * size)
        return np.frombuffer(self._file.read(size), np.uint8).reshape(self.shape)


_AGAIN = "Copy it from the camera again"


def contact_sheet(path: str | Path, frames: Sequence[Frame], title: str, columns: int = 6) -> None:
    """Write frames in rows, each under its number and time."""
    if not frames:
        raise InputError(path, "there are no frames to show")
    lines = [f"{frame.number}: {frame.time:.4f} s" for frame in frames]
    picture_sheet(path, [(line, frame.pixels) for line, frame in zip(lines, frames)], title, columns)


def sheet_numbers(count: int, most: int = 24) -> list[int]:
    """Numbers of at most ``most`` of ``count`` frames, evenly spaced, including the first and the last."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(most, count))})


class _FrameInfo(NamedTuple):
    number: int
    time: float
    width: int
    height: int


class _Decoder:
    """A running ffmpeg. It reports each frame on stderr before its pixels arrive."""

    def __init__(self, path: Path, process: subprocess.Popen):
        self.path = path
        self.process = process
        self._messages: Queue[str | None] = Queue()
        self._other_messages: list[str] = []
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for line in self.process.stderr:
            self._messages.put(line.decode(errors="replace").rstrip())
        self._messages.put(None)

    def infos(self) -> Iterator[_FrameInfo]:
        """Information on the frames in the order of their output."""
        count, tick = 0, np.nan
        while (message := self._messages.get()) is not None:
            if "Parsed_showinfo" not in message:
                self._other_messages.append(message)
                continue
            if match := _TIME_BASE.search(message):
                tick = int(match[1]) / int(match[2])
            elif match := _FRAME_INFO.search(message):
                number, width, height = int(match[1]), int(match[3]), int(match[4])
                if width * height > MAX_PIXELS or number >= MAX_FRAMES:
                    raise InputError(
                        self.path,
                        f"frame {number} of {width} x {height} pixels exceeds the limits of {MAX_PIXELS} pixels and"
                        f" {MAX_FRAMES} frames",
                        "Cut the video to the take",
                    )
                count += 1
                # pts_time has six digits only
                yield _FrameInfo(
                    number, int(match[2]) * tick if match[2] != "NOPTS" else np.nan, width, height
                )
        if self.process.wait() or count == 0:
            reasons = [m for m in self._other_messages if "rror" in m or "nvalid" in m or "no streams" in m]
            reason = one_line(reasons[-1]) if reasons else "it has no frames"
            raise InputError(self.path, f"cannot be read as a video ({reason})", f"{_AGAIN}, or remove it")

    def changes(self) -> np.ndarray:
        """Mean and maximum difference in brightness of each frame but the first from the previous one, (N - 1, 2)."""
        text = "\n".join(self._other_messages)
        columns = (re.findall(rf"lavfi\.signalstats\.{name}=([\d.e+-]+)", text) for name in ("YAVG", "YMAX"))
        return np.array(list(zip(*columns)), float).reshape(-1, 2)

    def noted_rate(self) -> float | None:
        """Recording rate noted in the file [frames per second], if any."""
        match = _NOTED_RATE.search("\n".join(self._other_messages))
        return float(match[1]) if match and float(match[1]) > 0 else None


@contextmanager
def _decoder(path: str | Path, pixels: bool) -> Iterator[_Decoder]:
    path = existing(path, "Put the video there, or correct its name")
    if path.stat().st_size == 0:
        raise InputError(path, "the file is empty", _AGAIN)
    output = ["-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"] if pixels else ["-f", "null", "-"]
    # V excludes cover pictures. ffmpeg rotates pictures upright before they reach a filter.
    command = [*ffmpeg_input(path, "-hide_banner", "-xerror"), "-map", "0:V:0"]
    compared = ",tblend=all_mode=difference,signalstats,metadata=print"
    command += [
        "-vf",
        f"showinfo=checksum=0{'' if pixels else compared}",
        "-fps_mode",
        "passthrough",
        "-threads",
        "1",
        *output,
    ]
    stdout = subprocess.PIPE if pixels else subprocess.DEVNULL
    process = start_child(command, stdout=stdout, stderr=subprocess.PIPE)
    try:
        yield _Decoder(path, process)
    finally:
        process.kill()
        process.wait()
        if process.stdout:
            process.stdout.close()
