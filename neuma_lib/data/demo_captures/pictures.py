"""Pictures of floors and walls that SIFT finds much in, never the same thing twice."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

LARGEST, SMALLEST = 0.10, 0.006
"""Radii of the things that lie on one another [m]."""
LEAST = 1.5
"""Smallest radius that is drawn [px]."""
COVER = 1.8
"""How often a place is covered, counted over all sizes."""
SIZES = 14
"""Sizes between the largest and the smallest, evenly in their logarithm; large ones lie below."""
BLACK, WHITE = 28, 225
"""Of print and paper, sRGB."""
TONES = np.array(
    [[196, 190, 178], [150, 140, 126], [106, 100, 94], [172, 158, 134], [128, 132, 138], [78, 74, 70]]
)
"""Colours of wood, stone and dust; the objects are brighter in colour than all of them."""


def dead_leaves(width: float, height: float, texel: float, seed: int) -> np.ndarray:
    """A picture of shapes of all sizes that lie on one another (the dead leaves model), sRGB (H, W, 3), uint8.

    Args:
        width, height: of the picture [m].
        texel: side of its pixels [m].
        seed: of the shapes.
    """
    rng = np.random.default_rng(seed)
    columns, rows = max(1, round(width / texel)), max(1, round(height / texel))
    image = Image.new("RGB", (columns, rows), tuple(int(c) for c in TONES[0]))
    draw = ImageDraw.Draw(image)
    for radius in np.geomspace(LARGEST, SMALLEST, SIZES):
        pixels = radius / texel
        if pixels < LEAST:
            break
        count = int(COVER / SIZES * columns * rows / (2 * pixels**2)) + 1
        middles = rng.random((count, 2)) * [columns, rows]
        turns = rng.random(count) * 2 * np.pi
        sides = rng.integers(3, 8, count)
        colours = np.clip(
            TONES[rng.integers(len(TONES), size=count)] + rng.normal(0, 14, (count, 1)), 20, 235
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
    """A printed page with a board in its middle, sRGB (H, W, 3), uint8; its sides are whole numbers of pixels.

    Args:
        black, white: rectangles, white ones over black ones: x, y of the left lower corner, width, height [m].
        board: width and height of the board, whose left lower corner the rectangles start from [m].
        paper: width and height of the paper, which is cut to whole pixels [m].
        texel: side of a pixel [m]; edges of rectangles should lie on edges of pixels.
    """
    columns, rows = (round(side / texel) for side in board)
    left, bottom = (int((whole - side) / 2 / texel) for whole, side in zip(paper, board))
    picture = np.full((rows + 2 * bottom, columns + 2 * left), WHITE, np.uint8)
    for rectangles, value in ((black, BLACK), (white, WHITE)):
        for x, y, w, h in rectangles / texel:
            top, end = rows + bottom - round(y + h), rows + bottom - round(y)
            picture[top:end, left + round(x) : left + round(x + w)] = value
    return np.repeat(picture[..., None], 3, axis=2)
