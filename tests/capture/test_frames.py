"""Frames of videos and their times, of files that ffmpeg writes here."""

import numpy as np
import pytest
from PIL import Image

from neuma_lib.capture import frames
from neuma_lib.capture.motion.timing import read_sound
from neuma_lib.errors import InputError
from tests.support.errors import refused
from tests.support.films import SIZE, TICKS, ffmpeg, film


@pytest.fixture(scope="module")
def variable(tmp_path_factory):
    """A second of a phone: 33 ms, 34 ms, with a gap of two frames, from 0.2 s on."""
    gaps = [3000, 3060, 2940, 9000, 3030, 2970, 3000, 3015, 2985]
    ticks = [18_000 + sum(gaps[:k]) for k in range(len(gaps) + 1)]
    return film(tmp_path_factory.mktemp("film") / "phone.mp4", ticks), np.array(ticks)


def test_times_are_those_of_the_file(variable):
    """To the tick: (N,) multiples of 1/90000 s."""
    path, ticks = variable
    timeline = frames.read_timeline(path)
    np.testing.assert_allclose(timeline.times - timeline.times[0], (ticks - ticks[0]) / TICKS, atol=1e-9)
    assert (timeline.width, timeline.height) == SIZE and timeline.stretch == 1
    assert not timeline.steady and timeline.lost.tolist() == [4]
    assert timeline.rate == pytest.approx(30, rel=0.01)


def test_times_are_exact_late_in_a_long_video(tmp_path):
    """Six digits would leave milliseconds."""
    path = film(tmp_path / "late.mkv", [0, 3003, 123_456_789, 123_459_792])
    got = frames.read_timeline(path).times
    # Matroska's clock ticks in milliseconds
    np.testing.assert_allclose(np.diff(got), np.diff([0, 0.033, 1371.742, 1371.775]), atol=1.01e-3)
    path = film(tmp_path / "late.mp4", [0, 3003, 123_456_789, 123_459_792])
    np.testing.assert_allclose(
        frames.read_timeline(path).times, np.array([0, 3003, 123_456_789, 123_459_792]) / TICKS, atol=1e-9
    )


def test_frames_come_with_their_times(variable):
    path, _ = variable
    timeline = frames.read_timeline(path)
    seen = list(frames.read_frames(path, timeline))
    assert [f.number for f in seen] == list(range(10))
    np.testing.assert_array_equal([f.time for f in seen], timeline.times)
    grey = [f.pixels.mean() for f in seen]
    np.testing.assert_allclose(grey, 10 + 5 * np.arange(10), atol=2)
    assert seen[0].pixels.shape == (SIZE[1], SIZE[0], 3)
    some = list(frames.read_frames(path, timeline, [7, 2]))
    assert [f.number for f in some] == [2, 7] and abs(some[1].pixels.mean() - 45) < 2
    assert list(frames.read_frames(path, timeline, [])) == []
    with refused(path):
        next(frames.read_frames(path, timeline, [10]))


def test_slow_motion(tmp_path):
    """240 frames a second, stored as 30: known from the note of a phone, or from the user."""
    ticks = [3000 * k for k in range(8)]
    tag = ("-movflags", "use_metadata_tags", "-metadata", "com.android.capture.fps=240.000000")
    path = film(tmp_path / "slow.mp4", ticks, *tag)
    timeline = frames.read_timeline(path)
    assert timeline.stretch == pytest.approx(8)
    np.testing.assert_allclose(np.diff(timeline.times), 1 / 240, rtol=1e-6)
    np.testing.assert_allclose(np.diff(frames.read_timeline(path, rate=120).times), 1 / 120, rtol=1e-6)
    real = film(tmp_path / "real.mp4", [k * 375 for k in range(8)], *tag)  # stored at the rate of filming
    assert frames.read_timeline(real).stretch == 1


def test_an_override_keeps_irregular_gaps(variable):
    path, ticks = variable
    timeline = frames.read_timeline(path, rate=60)
    np.testing.assert_allclose(
        np.diff(timeline.times) / np.diff(ticks / TICKS), 1 / timeline.stretch, rtol=1e-9
    )
    assert timeline.rate == pytest.approx(60)


def test_pictures_are_upright(tmp_path, variable):
    """A phone held upright writes lying pictures and a note to turn them."""
    path = tmp_path / "turned.mp4"
    ffmpeg("-display_rotation", 90, "-i", variable[0], "-c", "copy", path)
    timeline = frames.read_timeline(path)
    assert (timeline.width, timeline.height) == SIZE[::-1]
    assert next(frames.read_frames(path, timeline)).pixels.shape == (SIZE[0], SIZE[1], 3)


def check_refused(path):
    with refused(path):
        frames.read_timeline(path)


def test_files_that_are_no_video(tmp_path, variable):
    check_refused(tmp_path / "none.mp4")
    empty = tmp_path / "empty.mp4"
    empty.touch()
    check_refused(empty)
    text = tmp_path / "text.mp4"
    text.write_text("no video\n" * 100)
    check_refused(text)
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(variable[0].read_bytes()[:1500])
    check_refused(cut)
    sound = tmp_path / "sound.mp4"
    ffmpeg("-f", "lavfi", "-i", "sine=d=0.2", sound)
    check_refused(sound)
    playlist = tmp_path / "list.mp4"
    playlist.write_text(f"ffconcat version 1.0\nfile '{variable[0]}'\n")
    check_refused(playlist)
    Image.new("RGB", SIZE).save(tmp_path / "still.png")
    check_refused(tmp_path / "still.png")


def test_times_that_go_back(tmp_path, variable):
    path = tmp_path / "back.mkv"
    jump = "setts=pts=if(eq(N\\,5)\\,PTS-9000\\,PTS):dts=DTS"
    ffmpeg("-i", variable[0], "-c", "copy", "-bsf:v", jump, path)
    check_refused(path)
    with pytest.raises(InputError, match="decrease from frame 1 .* to frame 2"):
        frames.check_times([0.0, 0.1, 0.1], "here")
    with pytest.raises(InputError, match="frame 1 has no time stamp"):
        frames.check_times([0.0, np.nan, 0.1], "here")


def test_a_video_that_was_changed(tmp_path, variable):
    timeline = frames.read_timeline(variable[0])
    other = film(tmp_path / "other.mp4", [0, 3000, 6000])
    with refused(other):
        list(frames.read_frames(other, timeline))


def test_abandoned_decoding_ends_its_process(variable):
    timeline = frames.read_timeline(variable[0])
    some = frames.read_frames(variable[0], timeline)
    next(some)
    process = some.gi_frame.f_locals["decoder"].process
    some.close()
    assert process.poll() is not None


def test_contact_sheet(tmp_path, variable):
    timeline = frames.read_timeline(variable[0])
    numbers = frames.sheet_numbers(10, 4)
    assert numbers == [0, 3, 6, 9]
    read = list(frames.read_frames(variable[0], timeline, numbers))
    for name in ("a.png", "b.png"):
        frames.contact_sheet(tmp_path / name, read, "phone", columns=2)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with Image.open(tmp_path / "a.png") as sheet:
        greys = [np.asarray(sheet)[y, x].mean() for y in (200, 750) for x in (400, 1200)]
    np.testing.assert_allclose(greys, [10, 25, 40, 55], atol=2)
    with refused("c.png"):
        frames.contact_sheet(tmp_path / "c.png", [], "none")
    assert not (tmp_path / "c.png").exists()


MANIFESTS = {
    "hls": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n",
    "concat": "ffconcat version 1.0\nfile {}\n",
    "dash": '<MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static" profiles="urn:mpeg:dash:profile:isoff-on-demand:2011"'  # noqa: E501
    ' mediaPresentationDuration="PT1S"><Period>'
    '<AdaptationSet mimeType="video/mp4"><Representation id="0" bandwidth="1"><BaseURL>{}</BaseURL>'
    "</Representation></AdaptationSet></Period></MPD>",
}


@pytest.mark.parametrize("text", MANIFESTS.values(), ids=MANIFESTS)
@pytest.mark.parametrize("read", [frames.read_timeline, read_sound])
def test_manifests_read_no_other_file(variable, read, text):
    """A video that decodes is next to a manifest that names it."""
    other, _ = variable
    path = other.with_name("manifest.mp4")
    path.write_text(text.format(other.name))
    with refused(path):
        read(path)


def test_repeated_pictures_are_left_out(tmp_path):
    """Thirty pictures a second in a file of sixty, and single repeats; noise distinguishes pictures of one scene."""
    rng = np.random.default_rng(0)
    width, height = SIZE

    def write(path, shown, noise):
        pictures = 100 + rng.normal(0, noise, (max(shown) + 1, height, width))
        for k, picture in enumerate(pictures):
            picture[:, 2 * k : 2 * k + 12] += 80
        raw = np.clip(pictures, 0, 255).astype(np.uint8)[shown].tobytes()
        options = ("-f", "rawvideo", "-pix_fmt", "gray", "-s", f"{width}x{height}", "-r", 60, "-i", "-")
        ffmpeg(*options, "-c:v", "libx264", "-crf", 20, path, content=raw)
        return frames.read_timeline(path)

    doubled = write(tmp_path / "doubled.mp4", [k // 2 for k in range(40)], 4.0)
    assert doubled.repeated.tolist() == list(range(1, 40, 2))
    assert doubled.rate == pytest.approx(30) and doubled.steady and doubled.lost.tolist() == []
    kept = list(frames.read_frames(tmp_path / "doubled.mp4", doubled))
    assert [frame.number for frame in kept] == list(range(0, 40, 2))
    again = frames.timeline_of(doubled.plain())
    assert again.plain() == doubled.plain()
    stutter = write(tmp_path / "stutter.mp4", [*range(10), 9, *range(11, 20), 19, 19, *range(22, 30)], 4.0)
    assert stutter.repeated.tolist() == [10, 20, 21] and stutter.lost.tolist() == [11, 22]
    assert write(tmp_path / "whole.mp4", list(range(30)), 4.0).repeated.size == 0


def test_rest_and_the_highest_point_of_a_flight_are_no_repeated_pictures():
    """Without noise, pictures at rest are equal. The picture changes by the speed of the object."""
    rest, speed = np.zeros(10), np.abs(np.arange(-8, 9) + 0.4)

    def repeated(mean, largest):
        return frames.repeated_frames(np.stack([mean, largest], axis=1)).tolist()

    fall = np.concatenate([rest, speed, rest])
    assert repeated(fall, fall) == []
    assert repeated(rest, rest) == []
    assert repeated(rest[:0], rest[:0]) == []
    # Compression leaves out the background of frames 2 and 3, and the object moves in them.
    assert repeated(np.array([5.0, 0.1, 0.1, 5.0]), np.full(4, 90.0)) == []
    assert repeated(np.array([5.0, 0.1, 0.1, 5.0]), np.array([90.0, 9, 9, 90])) == [2, 3]
