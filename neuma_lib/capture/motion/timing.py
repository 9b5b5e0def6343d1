"""Time offsets between cameras, from their sound or from motion.

An offset is added to the second camera's times to convert them to the first camera's clock.
"""

import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import signal

from neuma_lib.capture.tools import ffmpeg_input
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, one_line
from neuma_lib.io.processes import start_child

RATE = 16_000  # sampling rate of the compared sound [Hz]
MAX_SOUND = 3600  # maximum duration of the sound of a video [s]: 230 MB at `RATE`
SOUND_SECONDS = 4.0
"""Maximum time to read the sound of a small file [s]. A sampling rate of 100 MHz takes much longer."""
SOUND_RATE = 500e3  # bytes of a larger file that may take a second more
_BAND = (300.0, 6000.0)  # band of claps and impacts, above hum and below the filters of phones [Hz]
SOUND_SPREAD = 0.005
"""Standard deviation of an offset due to the travel time of sound, 2.9 ms per metre, and delays in phones [s]."""
_MIN_PEAK = 6.0  # required height of a correlation peak, relative to the root mean square
MIN_CORRELATION = 0.5


@dataclass(frozen=True)
class Offset:
    """Seconds to add to the second camera's times, their standard deviation [s], and source: "sound" or "motion"."""

    seconds: float
    deviation: float
    source: str


def read_sound(path: str | Path) -> np.ndarray | None:
    """The sound of a video, mono at `RATE`, (N,), float32. None without sound. Raises InputError if it is no video."""
    path = existing(path, "Put the video there, or correct its name")
    # first_pts=0 keeps the clock that sound and picture share: sound that starts later is preceded by silence.
    command = [*ffmpeg_input(path, "-v", "error"), "-map", "0:a:0?", "-af", "aresample=async=1:first_pts=0"]
    command += ["-ac", "1", "-ar", str(RATE), "-t", str(MAX_SOUND + 1), "-f", "f32le", "pipe:1"]
    process = start_child(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    longest = SOUND_SECONDS + path.stat().st_size / SOUND_RATE
    try:
        sound, errors = process.communicate(timeout=longest)
    except subprocess.TimeoutExpired:
        problem = f"its sound cannot be read within {longest:.0f} s"
        raise InputError(path, problem, "Copy it from the camera again") from None
    finally:
        process.kill()
        process.wait()
    if len(sound) > 4 * RATE * MAX_SOUND:
        raise InputError(path, f"its sound is longer than {MAX_SOUND} s", "Cut the video to the take")
    message = errors.decode(errors="replace")
    if process.returncode and "does not contain any stream" not in message:
        problem = f"cannot be read as a video ({one_line(message)})"
        raise InputError(path, problem, "Copy it from the camera again")
    return np.frombuffer(sound, np.float32) if sound else None


def offset_from_sound(
    first: np.ndarray, second: np.ndarray, rate: float = RATE, longest: float = 10.0
) -> Offset | None:
    """Offset by the band-passed generalised cross-correlation with phase transform (Knapp and Carter 1976).

    Args:
        first, second: sound, (N,) and (M,).
        rate: sampling rate [Hz].
        longest: largest offset considered [s].

    Returns:
        None without a significant peak.
    """
    if min(len(first), len(second)) < rate / 10:
        return None
    size = 1 << int(np.ceil(np.log2(len(first) + len(second))))
    spectra = [np.fft.rfft(s, size) for s in (first, second)]
    cross = spectra[0] * spectra[1].conj()
    frequencies = np.fft.rfftfreq(size, 1 / rate)
    band = (frequencies >= _BAND[0]) & (frequencies <= _BAND[1])
    whitened = np.where(band, cross / np.maximum(np.abs(cross), 1e-12 * max(np.abs(cross).max(), 1e-300)), 0)
    correlation = np.abs(signal.hilbert(np.fft.irfft(whitened, size)))  # envelope
    reach = min(int(longest * rate), size // 2 - 2)
    lags = np.arange(-reach, reach + 1)
    values = correlation[lags]
    peak = int(np.argmax(values))
    spread = np.sqrt(np.mean(np.square(values)))
    if not 0 < peak < len(values) - 1 or values[peak] < _MIN_PEAK * spread:
        return None
    width = 1 / (_BAND[1] - _BAND[0])
    deviation = np.hypot(width, SOUND_SPREAD)
    return Offset(
        float((lags[peak] + _vertex(values[peak - 1 : peak + 2])) / rate), float(deviation), "sound"
    )


def offset_from_motion(
    times: tuple[np.ndarray, np.ndarray], signals: tuple[np.ndarray, np.ndarray], longest: float = 2.0
) -> Offset | None:
    """Offset by the correlation of a signal in both videos, such as the speed of a mask's centre.

    Args:
        times: of each camera's values [s], ascending.
        signals: one value per frame. Values that are not finite are left out.
        longest: largest offset considered [s].

    Returns:
        Offset with a standard deviation of a third of a frame. None if no correlation reaches `MIN_CORRELATION`.
    """
    kept = [(t[np.isfinite(s)], s[np.isfinite(s)]) for t, s in zip(times, signals)]
    if min(len(t) for t, _ in kept) < 5:
        return None
    interval = max(float(np.median(np.diff(t))) for t, _ in kept)
    (t1, s1), (t2, s2) = kept
    step = interval / 4
    # Lags are relative to the times of the files.
    lags = np.arange(-np.ceil(longest / step), np.ceil(longest / step) + 1) * step
    values = np.full(len(lags), -1.0)
    for i, lag in enumerate(lags):
        t = t1[(t1 >= t2[0] + lag) & (t1 <= t2[-1] + lag)]
        if len(t) < max(5, 0.5 * min(len(t1), len(t2))):
            continue
        a, b = np.interp(t, t1, s1), np.interp(t - lag, t2, s2)
        if a.std() > 0 and b.std() > 0:
            values[i] = np.corrcoef(a, b)[0, 1]
    peak = int(np.argmax(values))
    if not 0 < peak < len(lags) - 1 or values[peak] < MIN_CORRELATION:
        return None
    return Offset(float(lags[peak] + _vertex(values[peak - 1 : peak + 2]) * step), interval / 3, "motion")


def row_times(
    times: np.ndarray, rows: np.ndarray, row_time: float, height: int, sensor_rows: int
) -> np.ndarray:
    """Read-out times of rows by a rolling shutter, which reads from the top, (T,) [s].

    Distortion of the rows by the lens is neglected: 10 rows at 10 us are 0.1 ms.

    Args:
        times: of the frames, that is of their first rows, (T,) [s].
        rows: y in the undistorted pictures, (T,) [px].
        row_time: read-out time per row of the sensor [s].
        height: of the undistorted pictures [px].
        sensor_rows: rows of the recorded frames.
    """
    return times + row_time * rows * (sensor_rows / height)


def choose_offset(sound: Offset | None, motion: Offset | None, name: str) -> tuple[Offset, str]:
    """The offset with the smaller standard deviation, and a line of text. Raises InputError if both disagree."""
    offsets = [o for o in (sound, motion) if o is not None]
    if not offsets:
        problem = "neither sound nor motion determines the time offset between the cameras"
        raise InputError(name, problem, "Clap in view of all cameras while they film, or set the offset")
    listed = ", ".join(f"{o.source} {1e3 * o.seconds:.1f} +- {1e3 * o.deviation:.1f} ms" for o in offsets)
    if len(offsets) == 2:
        difference = abs(sound.seconds - motion.seconds)
        if difference > 4 * np.hypot(sound.deviation, motion.deviation):
            problem = f"the time offsets from sound and motion disagree ({listed})"
            raise InputError(name, problem, "Set the offset, or check that the videos show the same fall")
    best = min(offsets, key=lambda o: o.deviation)
    return best, f"{name}: time between the cameras by {best.source} ({listed})"


def _vertex(three: np.ndarray) -> float:
    """Position of the maximum of a parabola through three values at -1, 0, 1."""
    bend = three[0] - 2 * three[1] + three[2]
    return float(0.5 * (three[0] - three[2]) / bend) if bend < 0 else 0.0
