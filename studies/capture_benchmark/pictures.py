"""Textures of floors and walls with many distinct SIFT features."""

import numpy as np
from PIL import Image, ImageDraw

LARGEST, SMALLEST = 0.10, 0.006
"""Radii of the shapes [m]."""
MIN_RADIUS = 1.5  # smallest radius that is drawn [px]
COVER = 1.8  # mean number of shapes that cover a point
SIZES = 14
"""Number of sizes, evenly spaced in the logarithm. Small shapes are drawn over large ones."""
BLACK, WHITE = 28, 225
"""Levels of print and paper, sRGB."""
TONES = np.array(
    [[196, 190, 178], [150, 140, 126], [106, 100, 94], [172, 158, 134], [128, 132, 138], [78, 74, 70]]
)
"""Colours of wood, stone and dust, less saturated than those of the objects."""


def dead_leaves(
    width: float, height: float, texel: float, seed: int, tones: np.ndarray = TONES
) -> np.ndarray:
    """A picture of overlapping shapes of all sizes (dead leaves model), sRGB (H, W, 3), uint8.

    Args:
        width, height: of the picture [m].
        texel: side of its pixels [m].
        seed: of the shapes.
        tones: colours, sRGB, (6, 3).
    """
    rng = np.random.default_rng(seed)
    columns, rows = max(1, round(width / texel)), max(1, round(height / texel))
    image = Image.new("RGB", (columns, rows), tuple(int(c) for c in tones[0]))
    draw = ImageDraw.Draw(image)
    for radius in np.geomspace(LARGEST, SMALLEST, SIZES):
        pixels = radius / texel
        if pixels < MIN_RADIUS:
            break
        count = int(COVER / SIZES * columns * rows / (2 * pixels**2)) + 1
        middles = rng.random((count, 2)) * [columns, rows]
        turns = rng.random(count) * 2 * np.pi
        sides = rng.integers(3, 8, count)
        colours = np.clip(
            tones[rng.integers(len(tones), size=count)] + rng.normal(0, 14, (count, 1)), 20, 235
        )
        stretch = rng.uniform(0.5, 1.5, (count, 2))
        for middle, turn, side, colour, wide in zip(middles, turns, sides, colours.astype(int), stretch):
            angles = 2 * np.pi * np.arange(side) / side
            corners = pixels * wide * np.stack([np.cos(angles), np.sin(angles)], axis=1)
            spin = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
            draw.polygon([tuple(c) for c in middle + corners @ spin], fill=tuple(colour))
    grain = rng.normal(0, 5, (rows, columns, 1))
    return np.clip(np.asarray(image) + grain, 0, 255).astype(np.uint8)


def page_picture(
    black: np.ndarray, white: np.ndarray, board: tuple[float, float], paper: tuple[float, float], texel: float
) -> np.ndarray:
    """A printed page with a board in its middle, sRGB (H, W, 3), uint8.

    Args:
        black, white: rectangles, white ones over black ones: x, y of the lower left corner, width, height [m],
            relative to the lower left corner of the board.
        board: width and height of the board [m].
        paper: width and height of the paper [m], rounded down to whole pixels.
        texel: side of a pixel [m]. Edges of rectangles should lie on edges of pixels.
    """
    columns, rows = (round(side / texel) for side in board)
    left, bottom = (int((whole - side) / 2 / texel) for whole, side in zip(paper, board))
    picture = np.full((rows + 2 * bottom, columns + 2 * left), WHITE, np.uint8)
    for rectangles, value in ((black, BLACK), (white, WHITE)):
        for x, y, w, h in rectangles / texel:
            top, end = rows + bottom - round(y + h), rows + bottom - round(y)
            picture[top:end, left + round(x) : left + round(x + w)] = value
    return np.repeat(picture[..., None], 3, axis=2)


def ruler_picture(length: float, width: float, texel: float) -> np.ndarray:
    """A ruler with black and white fields of 2 cm, sRGB (H, W, 3), uint8, along its columns."""
    fields = (np.arange(round(length / texel)) * texel / 0.02).astype(int) % 2
    row = np.where(fields[:, None, None], BLACK, WHITE).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(row, (len(row), round(width / texel), 3)).swapaxes(0, 1))
