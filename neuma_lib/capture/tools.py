"""Optional packages for captures: OpenCV, COLMAP, ffmpeg and Matplotlib."""

import signal
import threading
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from neuma_lib.extras import require
from neuma_lib.io.files import atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Demuxers of ffmpeg that read one file. Others, such as dash, hls and concat, open files that their input names.
_CONTAINERS = "mov,matroska,avi,mpegts,mpeg,mpegvideo,h264,hevc,flv,ogg,asf,wav,flac,mp3,aac"


def opencv() -> ModuleType:
    """The module cv2. Raises InputError if it is not installed."""
    return require("cv2", "capture")


def colmap() -> ModuleType:
    """The module pycolmap. Raises InputError if it is not installed."""
    module = require("pycolmap", "capture")
    # Its handler of SIGTERM allocates memory for a stack trace and hangs if the signal interrupts an allocation.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return module


def new_figure(width: float, height: float) -> "Figure":
    """A figure of a size [in]. Raises InputError if Matplotlib is not installed."""
    figure = require("matplotlib.figure", "capture").Figure
    return figure(figsize=(width, height), layout="constrained")


def save_figure(path: str | Path, figure: "Figure") -> None:
    """Write a figure as PNG."""
    canvas = require("matplotlib.backends.backend_agg", "capture").FigureCanvasAgg(figure)
    with atomic(path) as partial:
        canvas.print_png(partial, metadata={"Software": None})


def ffmpeg_input(path: Path, *options: str) -> list[str]:
    """Command of ffmpeg with a video file as its input. Manifests and lists of other files are refused.

    Args:
        path: the file.
        options: global options.

    Raises:
        InputError: imageio-ffmpeg is not installed.
    """
    ffmpeg = require("imageio_ffmpeg", "capture").get_ffmpeg_exe()
    # The prefix file: keeps a file name from being parsed as a protocol.
    limits = ["-protocol_whitelist", "file", "-format_whitelist", _CONTAINERS]
    return [ffmpeg, "-nostdin", *options, *limits, "-i", f"file:{path.resolve()}"]
