"""Pictures in rows and columns: data file of a figure, and placement on its page."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath

from neuma_lib.errors import InputError
from neuma_lib.evaluation.plotting import style
from neuma_lib.io.files import parse_json
from neuma_lib.io.hdf5 import read_arrays, write_arrays

GAP = 0.02  # gap between pictures [in]
TITLE = 6.5  # font size of the titles of rows and columns [pt]
_TITLE_DISTANCE = 0.04  # distance of a row's title from its pictures, relative to the width of one


@dataclass(frozen=True)
class ImageGrid:
    """Pictures of one size in rows and columns, with further numbers of the figure."""

    images: np.ndarray  # colours 0 to 255, uint8, shape (R, C, H, W, 3)
    rows: tuple[str, ...]  # R titles
    columns: tuple[str, ...]  # C titles
    # other plain numbers, lists and texts of the figure by name
    numbers: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        expected = (len(self.rows), len(self.columns))
        if self.images.ndim != 5 or self.images.shape[:2] != expected or self.images.dtype != np.uint8:
            problem = f"{self.images.dtype} of shape {self.images.shape} for {expected} titles"
            raise InputError("images", f"{problem}, expected uint8 (rows, columns, H, W, 3)")

    def height(self, width: float, columns: int | None = None) -> float:
        """Height [in] of a picture if ``columns`` of them (all if None) with gaps fill ``width`` [in]."""
        count = columns or len(self.columns)
        return _picture_width(width, count) * self.images.shape[-3] / self.images.shape[-2]


def save_image_grid(path: str | Path, grid: ImageGrid) -> None:
    """Write pictures and titles to HDF5."""
    text = {name: json.dumps(getattr(grid, name)) for name in ("rows", "columns", "numbers")}
    write_arrays(path, {"images": grid.images}, text)


def load_image_grid(path: str | Path) -> ImageGrid:
    """Read pictures and titles. Raises InputError if the file is not the data of a figure."""
    arrays, attributes = read_arrays(path, required=("images",))
    missing = [name for name in ("rows", "columns", "numbers") if name not in attributes]
    if missing:
        problem = f"not the data of a figure, it has no {', '.join(missing)}"
        raise InputError(path, problem, "Build the figure again")
    rows, columns, numbers = (parse_json(attributes[name], path) for name in ("rows", "columns", "numbers"))
    return ImageGrid(arrays["images"], tuple(rows), tuple(columns), numbers)


def place(figure: Figure, left: float, top: float, width: float, height: float, **options) -> Axes:
    """Axes with their upper left corner at (left, top) inches from that of the figure."""
    full_width, full_height = figure.get_size_inches()
    box = (left / full_width, 1 - (top + height) / full_height, width / full_width, height / full_height)
    return figure.add_axes(box, **options)


def draw_images(
    figure: Figure,
    images: np.ndarray,
    left: float,
    top: float,
    width: float,
    rows: Sequence[str] = (),
    columns: Sequence[str] = (),
) -> None:
    """Draw pictures (R, C, H, W, 3) below and right of (left, top) [in].

    Args:
        width: total width of the pictures [in].
        rows: titles left of the pictures, wrapped to the width `left`.
        columns: titles above them.
    """
    each = _picture_width(width, images.shape[1])
    height = each * images.shape[2] / images.shape[3]
    for i, row in enumerate(images):
        for j, image in enumerate(row):
            axes = place(figure, left + j * (each + GAP), top + i * (height + GAP), each, height)
            axes.imshow(image, interpolation="antialiased", aspect="auto")
            axes.set_axis_off()
            options = {"transform": axes.transAxes, "fontsize": TITLE}
            if i == 0 and j < len(columns):
                axes.text(0.5, 1.02, columns[j], ha="center", va="bottom", **options)
            if j == 0 and i < len(rows):
                title = broken(rows[i], left - _TITLE_DISTANCE * each - GAP)
                axes.text(-_TITLE_DISTANCE, 0.5, title, ha="right", va="center", **options)


def rows_figure(grid: ImageGrid, left: float, top: float, rows: Sequence[str]) -> Figure:
    """A figure of the page's width with the pictures and titles of a grid only."""
    width = style.PAGE - left - 0.02
    figure = style.new_canvas(style.PAGE, top + len(rows) * (grid.height(width) + GAP) + 0.03)
    draw_images(figure, grid.images, left, top, width, rows, grid.columns)
    return figure


def broken(text: str, width: float) -> str:
    """Wrap a text at spaces to lines of at most `width` [in], longer only for long words."""
    lines: list[str] = []
    for line in text.split("\n"):
        words = line.split(" ")
        lines.append(words[0])
        for word in words[1:]:
            longer = f"{lines[-1]} {word}"
            if TextPath((0, 0), longer, size=TITLE).get_extents().width <= 72 * width:
                lines[-1] = longer
            else:
                lines.append(word)
    return "\n".join(lines)


def note(figure: Figure, left: float, top: float, text: str, **options) -> None:
    """Add text at (left, top) inches from the upper left corner."""
    width, height = figure.get_size_inches()
    figure.text(
        left / width, 1 - top / height, text, **{"ha": "left", "va": "center", "fontsize": 7, **options}
    )


def _picture_width(width: float, columns: int) -> float:
    return (width - GAP * (columns - 1)) / columns
