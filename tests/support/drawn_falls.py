"""Drawn pictures of a ball that falls on a floor in a room."""

import numpy as np
from scipy import ndimage

WIDTH, HEIGHT = 320, 240
COUNT, CONTACT = 26, 19
TIMES = np.arange(COUNT) / 60


def texture(seed=0):
    """A room: smooth patches with fine grain, (H, W, 3)."""
    rng = np.random.default_rng(seed)
    rough = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH, 3)), (12, 12, 0))
    fine = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH, 3)), (1, 1, 0))
    return np.clip(115 + 700 * rough + 90 * fine, 25, 200)


def places():
    """Of the centre: a fall from rest on to the floor, where it stays."""
    t = np.minimum(TIMES, TIMES[CONTACT])
    return np.stack([120 + 60 * t, 40 + 0.5 * 2700 * t * t], axis=1)


def ellipse(place, rx=17.0, ry=13.0):
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return ((x - place[0]) / rx) ** 2 + ((y - place[1]) / ry) ** 2 <= 1


def film(background, hand=False, shadow=False, gain=(1.0, 1.0, 1.0), noise=2.0, colour=(225, 70, 40)):
    """Frames (T, H, W, 3), uint8, of a red ball before a background."""
    rng = np.random.default_rng(3)
    frames = []
    for i, place in enumerate(places()):
        picture = background.copy()
        if shadow:  # soft, on the floor below the ball
            dark = ellipse((place[0] + 12, 193.0), 26, 7).astype(float)
            picture *= 1 - 0.35 * ndimage.gaussian_filter(dark, 2)[..., None]
        if hand and i < 12:
            reach = 150 - 9 * i
            picture[20:60, :reach] = np.where(ellipse(place)[20:60, :reach, None], 0, (190, 150, 120))
        grey = 0.85 + 0.3 * ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 3)
        picture = np.where(ellipse(place)[..., None], np.array(colour) * grey[..., None], picture)
        picture = picture * (1 + (np.array(gain) - 1) * i / COUNT) + rng.normal(0, noise, picture.shape)
        frames.append(np.clip(picture, 0, 255).astype(np.uint8))
    return frames


TONES = np.array(
    [[196, 190, 178], [150, 140, 126], [106, 100, 94], [172, 158, 134], [128, 132, 138], [78, 74, 70]], float
)


def stony(seed=5):
    """A floor of overlapping stones of six greys and browns, (H, W, 3)."""
    rng = np.random.default_rng(seed)
    picture = np.full((HEIGHT, WIDTH, 3), 150.0)
    for radius in np.exp(np.linspace(np.log(24), np.log(2), 12)):
        for _ in range(int(0.5 * WIDTH * HEIGHT / (np.pi * radius**2))):
            place = rng.uniform(-radius, (WIDTH + radius, HEIGHT + radius))
            rows, columns = (
                slice(int(max(0, c - radius)), int(max(0, c + radius + 1))) for c in (place[1], place[0])
            )
            y, x = np.mgrid[:HEIGHT, :WIDTH][:, rows, columns] + 0.5
            turn, ratio = rng.uniform(0, np.pi), rng.uniform(0.5, 1)
            along = np.cos(turn) * (x - place[0]) + np.sin(turn) * (y - place[1])
            across = np.cos(turn) * (y - place[1]) - np.sin(turn) * (x - place[0])
            stone = (along / radius) ** 2 + (across / (ratio * radius)) ** 2 <= 1
            picture[rows, columns][stone] = TONES[rng.integers(len(TONES))]
    return ndimage.gaussian_filter(picture, (0.6, 0.6, 0))


def to_light(levels):
    return (np.asarray(levels, float) / 255) ** 2.2


def film_of_contact(background, colour, size=(40.0, 30.0), noise=2.0):
    """Frames (T, H, W, 3), uint8, and silhouettes (T, H, W) of a ball that is lit from above and lands on a floor.

    Two lamps cast its shadows, which become darker and sharper near the floor. At contact almost no light is left
    under the ball, and the rest has its colour.
    """
    rng = np.random.default_rng(3)
    rx, ry = size
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    light, own = to_light(background), to_light(colour)
    grain = ndimage.gaussian_filter(rng.normal(size=(2 * HEIGHT, 2 * WIDTH)), 2.5)
    grain = 1 + 0.15 * grain / grain.std()
    frames, silhouettes = [], []
    for place in places() + [30.0, -15.0]:
        height = places()[CONTACT, 1] - 15.0 - place[1]
        foot, blur = places()[CONTACT, 1] - 15.0 + 0.55 * ry, 1.5 + 0.12 * height
        lamps = [
            ndimage.gaussian_filter(ellipse((place[0] + side, foot), w * rx, h * ry).astype(float), blur)
            for side, w, h in ((0.25 * height + 6, 1.05, 0.62), (-0.35 * height - 8, 1.0, 0.55))
        ]
        under = ellipse((place[0] + 0.25 * height + 6, foot), 0.6 * rx, 0.4 * ry).astype(float)
        under = ndimage.gaussian_filter(under, 2 + 0.1 * height) * (height < 40)
        lit = np.minimum(1 - 0.55 * lamps[0] - 0.40 * lamps[1], 1 - 0.95 * under)
        reflected = 0.05 * np.exp(-height / 30) * lamps[0][..., None] * own
        floor = light * (lit[..., None] + reflected)
        body = own * np.clip(1 - 0.75 * (y - place[1] + ry) / (2 * ry), 0.2, 1)[..., None]
        top, left = (int(c) for c in (HEIGHT - place[1], WIDTH - place[0]))
        body = body * grain[top : top + HEIGHT, left : left + WIDTH, None]
        whole = ellipse(place, rx, ry)
        cover = ndimage.gaussian_filter(whole.astype(float), 0.6)[..., None]
        seen = 255 * (cover * body + (1 - cover) * floor) ** (1 / 2.2) + rng.normal(
            0, noise, background.shape
        )
        frames.append(np.clip(np.rint(seen), 0, 255).astype(np.uint8))
        silhouettes.append(whole)
    return frames, np.array(silhouettes)
