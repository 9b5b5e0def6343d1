"""Bodies at rest: photograph, predicted silhouette, and the difference of silhouettes, under the clamp that fits best.
Grey: both silhouettes; orange: observed only; blue: predicted only; light grey: hidden parts, which are not compared.
Not in the paper.
"""

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from skimage.draw import polygon2mask

from neuma_lib.evaluation.plotting import style
from neuma_lib.io.files import read_json, reading
from neuma_lib.paper.image_grid import ImageGrid, rows_figure

COLUMNS = ("Photograph", "Prediction", "Difference")
LEFT, TOP = 0.75, 0.16
_MARGIN = 25  # around both silhouettes [px]
_ASPECT = 0.9  # height of a picture by its width
_WIDTH = 480  # px
_BOTH, _OBSERVED, _PREDICTED, _HIDDEN = (150, 150, 150), (230, 159, 0), (0, 114, 178), (225, 225, 225)
_DIM = 0.45  # of the photograph behind the prediction


def data(inputs, params, log) -> ImageGrid:
    """A row for each body, of the first photograph of its record."""
    rows, titles = [], []
    for title, photograph, mask, file in zip(
        params.titles, inputs.photographs, inputs.masks, inputs.results, strict=True
    ):
        with reading(photograph, "an image"), Image.open(photograph) as image:
            picture = np.asarray(image.convert("RGB"))
        with reading(mask, "an image"), Image.open(mask) as image:
            observed = np.asarray(image.convert("L")) > 127
        result = read_json(file)
        clamp, values = min(result["clamps"].items(), key=lambda item: item[1]["cost"])
        filled = [_filled(values[key], observed.shape) for key in ("silhouette", "hidden")]
        pictures = _row(picture if params.photographs else np.full_like(picture, 255), observed, *filled)
        rows.append(pictures if params.photographs else pictures[1:])
        predicted = " (predicted)" if result["predicted_from"] else ""
        numbers = f"μ/ρ {values['ratio']:.0f} m²/s²\n{values['contour_rms']:.1f} px, IoU {values['iou']:.3f}"
        titles.append(f"{title}{predicted}\nclamp {clamp}\n{numbers}")
        log(titles[-1].replace("\n", ", "))
    columns = COLUMNS if params.photographs else COLUMNS[1:]
    return ImageGrid(np.stack([np.stack(row) for row in rows]), tuple(titles), columns)


def _filled(lines: list, shape: tuple[int, ...]) -> np.ndarray:
    """Mask (H, W) inside closed lines of (x, y) [px], with holes."""
    result = np.zeros(shape, dtype=bool)
    for line in lines:
        result ^= polygon2mask(shape, np.array(line)[:, ::-1] - 0.5)
    return result


def _row(
    picture: np.ndarray, observed: np.ndarray, predicted: np.ndarray, hidden: np.ndarray
) -> list[np.ndarray]:
    """Photograph, prediction on it, and difference, cropped to one size."""
    outline = predicted ^ (
        predicted & np.roll(predicted, 1, 0) & np.roll(predicted, -1, 0)
        & np.roll(predicted, 1, 1) & np.roll(predicted, -1, 1)
    )  # fmt: skip
    tinted = (picture * _DIM + 255 * (1 - _DIM)).astype(np.uint8)
    tinted[predicted & ~hidden] = (0.5 * tinted[predicted & ~hidden] + 0.5 * np.array(_PREDICTED)).astype(
        np.uint8
    )
    tinted[outline] = 0
    difference = np.full_like(picture, 255)
    for part, colour in (
        (observed & predicted, _BOTH),
        (observed & ~predicted, _OBSERVED),
        (predicted & ~observed, _PREDICTED),
        (hidden & (observed | predicted), _HIDDEN),
    ):
        difference[part] = colour
    y, x = np.nonzero(observed | (predicted & ~hidden))
    centre = (y.min() + y.max()) / 2, (x.min() + x.max()) / 2
    width = max(np.ptp(x), np.ptp(y) / _ASPECT) + 2 * _MARGIN
    sites = [
        np.clip((np.arange(n) + 0.5) / n * size + middle - size / 2, 0, limit - 1).astype(int)
        for n, size, middle, limit in zip(
            (round(_WIDTH * _ASPECT), _WIDTH), (width * _ASPECT, width), centre, observed.shape, strict=True
        )
    ]
    return [image[np.ix_(*sites)] for image in (picture, tinted, difference)]


@style.styled
def draw(grid: ImageGrid) -> Figure:
    return rows_figure(grid, LEFT + 0.55, TOP, grid.rows)
