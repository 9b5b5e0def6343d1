"""Pictures in rows and columns, placed to the hundredth of an inch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath

GAP = 0.02
"""Between pictures [in]."""
TITLE = 6.5
"""Size of the titles of rows and columns [pt]."""


def picture_height(images: np.ndarray, columns: int, width: float) -> float:
    """Height [in] of a picture of the grid ``images`` (..., H, W, 3) when ``columns`` of them fill ``width`` [in]."""
    each = (width - GAP * (columns - 1)) / columns
    return each * images.shape[-3] / images.shape[-2]


def place(figure: Figure, left: float, top: float, width: float, height: float, **options) -> Axes:
    """Axes whose upper left corner lies at (left, top) inches from that of the figure."""
    full_width, full_height = figure.get_size_inches()
    box = (left / full_width, 1 - (top + height) / full_height, width / full_width, height / full_height)
    return figure.add_axes(box, **options)


def image_grid(
    figure: Figure,
    images: np.ndarray,
    left: float,
    top: float,
    width: float,
    rows: Sequence[str] = (),
    columns: Sequence[str] = (),
) -> float:
    """Draw pictures (R, C, H, W, 3) below and right of (left, top) [in]; their lower end [in].

    Args:
        width: of the pictures together [in].
        rows: titles left of the pictures, broken where they are wider than `left`.
        columns: titles above them.
    """
    count = images.shape[1]
    height = picture_height(images, count, width)
    each = (width - GAP * (count - 1)) / count
    for i, row in enumerate(images):
        for j, image in enumerate(row):
            axes = place(figure, left + j * (each + GAP), top + i * (height + GAP), each, height)
            axes.imshow(image, interpolation="antialiased", aspect="auto")
            axes.set_axis_off()
            if i == 0 and j < len(columns):
                axes.text(
                    0.5, 1.02, columns[j], transform=axes.transAxes, ha="center", va="bottom", fontsize=TITLE
                )
            if j == 0 and i < len(rows):
                title = broken(rows[i], left - 0.04 * each - GAP)
                axes.text(
                    -0.04, 0.5, title, transform=axes.transAxes, ha="right", va="center", fontsize=TITLE
                )
    return top + len(images) * (height + GAP) - GAP


def broken(text: str, width: float) -> str:
    """The text with lines broken at spaces so that none is wider than `width` [in], unless a word is."""
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
    """Text at (left, top) inches from the upper left corner."""
    width, height = figure.get_size_inches()
    figure.text(
        left / width, 1 - top / height, text, **{"ha": "left", "va": "center", "fontsize": 7, **options}
    )
