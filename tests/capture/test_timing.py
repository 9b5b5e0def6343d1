"""Offsets between cameras: known delays of sound and motion."""

import numpy as np
import pytest
from scipy.io import wavfile

from neuma_lib.capture.motion import timing
from neuma_lib.capture.motion.timing import (
    RATE,
    Offset,
    choose_offset,
    offset_from_motion,
    offset_from_sound,
    read_sound,
)
from neuma_lib.errors import InputError
from tests.support.errors import refused
from tests.support.films import ffmpeg


def test_a_known_delay_of_sound_is_found_below_a_millisecond():
    rng = np.random.default_rng(0)
    room = rng.normal(size=3 * RATE) * np.exp(-(((np.arange(3 * RATE) / RATE - 1.2) / 0.05) ** 2))
    late = 1234  # samples by which the second camera began earlier: it hears all later
    first = room + 0.02 * rng.normal(size=len(room))
    second = 0.3 * np.roll(room, late) + 0.02 * rng.normal(size=len(room))
    result = offset_from_sound(first, second)
    assert result.seconds == pytest.approx(-late / RATE, abs=2e-4)


def test_sound_that_has_nothing_in_common_gives_no_offset():
    rng = np.random.default_rng(0)
    assert offset_from_sound(rng.normal(size=RATE), rng.normal(size=RATE)) is None


def test_motion_gives_the_offset_within_a_third_of_a_frame():
    t1, t2 = np.arange(60) / 60, np.arange(70) / 50
    speed = lambda t: np.exp(-(((t - 0.5) / 0.1) ** 2))  # noqa: E731
    offset = -0.137
    result = offset_from_motion((t1, t2), (speed(t1), speed(t2 + offset)))
    assert abs(result.seconds - offset) < result.deviation


def test_the_surer_offset_is_chosen_and_reported():
    sound, motion = Offset(0.1, 0.005, "sound"), Offset(0.104, 0.003, "motion")
    best, line = choose_offset(sound, motion, "mug")
    assert best is motion and "sound 100.0 +- 5.0 ms" in line
    assert choose_offset(sound, None, "mug")[0] is sound
    with refused("mug"):
        choose_offset(None, None, "mug")
    with pytest.raises(InputError, match="mug: .*disagree"):
        choose_offset(sound, Offset(0.2, 0.003, "motion"), "mug")


def test_sound_keeps_the_clock_of_its_video(tmp_path):
    """A click 0.5 s into sound that begins 0.25 s after the picture is heard at 0.75 s."""
    samples = np.zeros(RATE, np.float32)
    samples[RATE // 2] = 1.0
    sound = tmp_path / "click.wav"
    wavfile.write(sound, RATE, samples)
    pictures = ("-f", "lavfi", "-i", "testsrc=s=64x48:r=30:d=2")
    path = tmp_path / "a.mov"
    ffmpeg(*pictures, "-itsoffset", 0.25, "-i", sound, "-c:v", "libx264", "-c:a", "pcm_f32le", path)
    heard = read_sound(path)
    assert abs(int(np.abs(heard).argmax()) - 0.75 * RATE) <= 16  # a millisecond
    silent = tmp_path / "b.mp4"
    ffmpeg(*pictures, "-c:v", "libx264", silent)
    assert read_sound(silent) is None
    (tmp_path / "c.mp4").write_text("no video")
    with refused("c.mp4"):
        read_sound(tmp_path / "c.mp4")
    with refused("d.mp4"):
        read_sound(tmp_path / "d.mp4")


def test_a_sampling_rate_of_a_hundred_megahertz_is_refused(tmp_path, monkeypatch):
    """The decoder would compute filters for seconds."""
    monkeypatch.setattr(timing, "SOUND_SECONDS", 0.5)
    path = tmp_path / "fast.wav"
    ffmpeg("-f", "lavfi", "-i", "anullsrc=r=44100:cl=mono", "-t", 0.01, path)
    content = bytearray(path.read_bytes())
    content[24:28] = (134_261_828).to_bytes(4, "little")
    path.write_bytes(content)
    with refused(path, problem="cannot be read within"):
        read_sound(path)


def test_sound_of_hours_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    """The decoder stops at the limit: 20 s of sound give 2 s of samples."""
    path = tmp_path / "long.flac"
    ffmpeg("-f", "lavfi", "-i", "anullsrc=r=16000:cl=mono", "-t", 20, path)
    assert len(read_sound(path)) == 20 * RATE
    monkeypatch.setattr(timing, "MAX_SOUND", 1)
    with refused(path, problem="longer than 1 s"):
        read_sound(path)
