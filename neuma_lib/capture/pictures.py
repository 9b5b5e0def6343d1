"""Photographs and stills in groups that share a lens: `photographs`, and one group per fixed camera.

The name of a picture is ``<group>/<file>``. Pictures keep the orientation of the sensor. EXIF orientation is removed,
because tools interpret it differently, and because the lens does not depend on how a phone is held.
"""

import shutil
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from neuma_lib.capture.calibration.lens import Lens
from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.io.files import atomic, read_regular, reading
from neuma_lib.io.images import open_image
from neuma_lib.project.capture_folder import HEIF

ORIENTATION = 0x0112  # EXIF tag of the orientation
QUARTER_TURNS = {1: 0, 6: 1, 3: 2, 8: 3}
"""Clockwise quarter turns after which a stored picture is upright, by EXIF orientation."""
_STORED_UPRIGHT = 6  # orientation of a picture that was stored upright and turned back by `read_picture`
SHEET_WIDTH = 1600  # width of a contact sheet [px]


def group_of(name: str) -> str:
    """Group of a picture."""
    return name.split("/")[0]


def picture_name(group: str, file: str | Path) -> str:
    """Name of a picture in a group. HEIC pictures are converted to PNG."""
    path = Path(file)
    return f"{group}/{path.with_suffix('.png').name if path.suffix.lower() in HEIF else path.name}"


def name_pictures(groups: Mapping[str, Sequence[Path]]) -> dict[str, Path]:
    """Name of each picture -> its file.

    Raises:
        InputError: a file is no picture, or sizes in a group differ by more than a quarter turn.
    """
    named: dict[str, Path] = {}
    for group, files in groups.items():
        sizes: dict[tuple[int, ...], Path] = {}
        for file in map(Path, files):
            sizes.setdefault(tuple(sorted(picture_size(file))), file)
            named[picture_name(group, file)] = file
        if len(sizes) > 1:
            a, b = list(sizes.values())[:2]
            first, second = picture_size(a), picture_size(b)
            raise InputError(
                b,
                f"{second[0]}x{second[1]} pixels, but {a} has {first[0]}x{first[1]}",
                f"Take all pictures of '{group}' with one camera at one zoom and size, and do not crop them",
            )
    return named


def sensor_sizes(pictures: Mapping[str, Path]) -> dict[str, tuple[int, int]]:
    """Width and height of the sensor of each picture [px]: the size that most pictures of its group have.

    Some phones and programs store photographs turned instead of noting their orientation. `read_picture` turns them
    back, since a lens belongs to the sensor.
    """
    counts: dict[str, Counter] = {}
    sizes = {name: picture_size(file) for name, file in pictures.items()}
    for name, size in sizes.items():
        counts.setdefault(group_of(name), Counter())[size] += 1
    return {name: counts[group_of(name)].most_common(1)[0][0] for name in pictures}


def picture_size(file: Path) -> tuple[int, int]:
    """Width and height as stored [px]. Raises InputError for a file that is no picture."""
    with _opened(file) as image:
        return image.size


def _opened(file: str | Path, content: bytes | None = None) -> Image.Image:
    """A picture of which only the header is read, in one of the supported formats, or HEIC if its decoder is there."""
    if Path(file).suffix.lower() in HEIF:
        require("pillow_heif", "capture").register_heif_opener()
        return open_image(read_regular(file) if content is None else content, file, formats=("HEIF",))
    return open_image(read_regular(file) if content is None else content, file)


def orientation_of(file: Path, size: tuple[int, int]) -> int | None:
    """EXIF orientation of a picture as `read_picture` returns it for a size. None if it is not known."""
    with _opened(file) as image, reading(file, "an image"):
        stated = image.getexif().get(ORIENTATION)
        return _STORED_UPRIGHT if image.size != tuple(size) and stated in (None, 1) else stated


def sensor_pixels(places: np.ndarray, orientation: int | None, size: tuple[int, int]) -> np.ndarray:
    """Places (P, 2) [px] in the sensor's width and height from those in an upright, displayed picture.

    ``orientation`` is that of `orientation_of`. Mirrored orientations do not occur in photographs.
    """
    x, y = np.asarray(places, float).T
    width, height = size
    turned = [(x, y), (y, height - x), (width - x, height - y), (width - y, x)]
    return np.stack(turned[QUARTER_TURNS.get(orientation or 1, 0)], axis=-1)


@contextmanager
def evidence(output: str | Path, draw: Callable[[Path], None]) -> Iterator[None]:
    """If the block raises an `InputError`, draw what the stage saw and name the picture in the message.

    The picture lies next to an output as ``<output>.failed.png``, because Snakemake deletes the outputs of a failed
    job. It is deleted when the stage runs again.

    Args:
        output: a picture that the stage writes.
        draw: writes the picture to a path.
    """
    path = Path(output).with_suffix(".failed.png")
    path.unlink(missing_ok=True)
    try:
        yield
    except InputError as error:
        try:
            draw(path)
        except InputError:
            raise error from None  # what cannot be drawn is often the problem itself
        remedy = f"{error.remedy.rstrip('.')}. " if error.remedy else ""
        raise InputError(error.where, error.problem, f"{remedy}See {path}") from error


def copy_pictures(pictures: Mapping[str, Path], target: str | Path) -> dict[str, Path]:
    """Copy pictures by name to <target>/<name>, in sensor orientation and without EXIF orientation.

    Raises InputError for damaged files.
    """
    copies, sizes = {name: Path(target) / name for name in pictures}, sensor_sizes(pictures)
    for name, file in pictures.items():
        content = read_regular(file)
        with _opened(file, content) as image:
            with reading(file, "an image"):
                rotated = image.getexif().get(ORIENTATION, 1) != 1
            with atomic(copies[name]) as partial:
                if image.size == sizes[name] and not rotated and image.format != "HEIF":
                    shutil.copyfile(file, partial)
                elif image.size == sizes[name] and image.format == "JPEG":
                    with reading(file, "an image"):
                        reset_content = _reset_orientation(content, image.info["exif"])
                    partial.write_bytes(reset_content)
                else:
                    pixels = Image.fromarray(read_picture(file, sizes[name]))
                    kind = "PNG" if image.format == "HEIF" else image.format
                    lossless = {"quality": 98, "subsampling": 0} if kind == "JPEG" else {"lossless": True}
                    notes = image.getexif()  # with the focal length
                    notes[ORIENTATION] = 1
                    pixels.save(partial, kind, exif=notes, **lossless)
    return copies


def _reset_orientation(content: bytes, exif: bytes) -> bytes:
    """Reset the orientation in the first EXIF directory of a JPEG file (TIFF 6.0, section 2), without recoding it.

    Raises ValueError or struct.error for damaged EXIF data.
    """
    if exif not in content:
        raise ValueError("its EXIF data are in several parts")
    tiff = exif.index(b"Exif\0\0") + 6
    order = "<" if exif[tiff : tiff + 2] == b"II" else ">"
    directory = tiff + struct.unpack_from(f"{order}I", exif, tiff + 4)[0]
    changed = bytearray(exif)
    for entry in range(struct.unpack_from(f"{order}H", exif, directory)[0]):
        at = directory + 2 + 12 * entry
        if struct.unpack_from(f"{order}H", exif, at)[0] == ORIENTATION:
            struct.pack_into(f"{order}H", changed, at + 8, 1)
    return content.replace(exif, bytes(changed), 1)


def read_picture(file: str | Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """RGB (H, W, 3), uint8, as stored. Turned counterclockwise if only then it has a width and height."""
    with _opened(file) as image, reading(file, "an image"):
        pixels = np.asarray(image.convert("RGB"))
    turned = size is not None and pixels.shape[:2] == tuple(size) != pixels.shape[1::-1]
    return np.ascontiguousarray(np.rot90(pixels)) if turned else pixels


def write_png(path: str | Path, pixels: np.ndarray) -> None:
    """Write RGB or RGBA pixels, uint8."""
    with atomic(path) as partial:
        Image.fromarray(pixels).save(partial, "PNG")


def undistorted(pixels: np.ndarray, lens: Lens, longest: int) -> np.ndarray:
    """Resample a picture (H, W, 3), uint8, to the lens of `Lens.pinhole` and `Lens.resized`."""
    smaller = lens.pinhole().resized(longest)
    whole = lens.undistort(pixels)
    if (smaller.width, smaller.height) == (lens.width, lens.height):
        return whole
    cv2 = opencv()
    return cv2.resize(whole, (smaller.width, smaller.height), interpolation=cv2.INTER_AREA)


def picture_sheet(
    path: str | Path, pictures: Sequence[tuple[str, np.ndarray]], title: str, columns: int
) -> None:
    """Write pictures in rows, each under a line of text.

    Args:
        pictures: line of text and RGB pixels (H, W, 3), uint8, of each picture.
        title: first line of the sheet.
        columns: maximum number of pictures in a row.
    """
    font = ImageFont.load_default(14)
    columns = min(columns, len(pictures))
    width = SHEET_WIDTH // columns
    heights = [round(width * pixels.shape[0] / pixels.shape[1]) for _, pixels in pictures]
    line = 20
    rows = [max(heights[k : k + columns]) for k in range(0, len(pictures), columns)]
    sheet = Image.new("RGB", (columns * width, line + sum(rows) + line * len(rows)), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((4, 2), title, fill="black", font=font)
    for i, ((text, pixels), height) in enumerate(zip(pictures, heights)):
        row = i // columns
        x, y = (i % columns) * width, line + sum(rows[:row]) + line * row
        draw.text((x + 4, y + 2), text, fill="black", font=font)
        sheet.paste(Image.fromarray(pixels).resize((width - 2, height), Image.LANCZOS), (x, y + line))
    write_png(path, np.asarray(sheet))
