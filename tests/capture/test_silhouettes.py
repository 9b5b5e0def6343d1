"""Silhouettes before a background: light and levels, shadows and tints, minimum cost, mixed pixels at the edge."""

import numpy as np
import pytest

from tests.support.drawn_falls import HEIGHT, WIDTH, ellipse, stony

pytest.importorskip("cv2")

from neuma_lib.capture.masks import silhouettes  # noqa: E402


def test_levels_and_light_are_each_others_inverse():
    levels = np.linspace(0, 255, 511, dtype=np.float32)
    np.testing.assert_allclose(silhouettes.coded(silhouettes.linear(levels)), levels, atol=1e-2)
    light = np.linspace(0.001, 1, 200, dtype=np.float32)
    slope = (silhouettes.coded(light + 1e-4) - silhouettes.coded(light - 1e-4)) / 2e-4
    np.testing.assert_allclose(silhouettes._levels_by_light(light), slope, rtol=0.02)


def explained(light):
    background = stony().astype(np.float32)
    picture = silhouettes.coded(light * silhouettes.linear(background))
    picture += np.random.default_rng(1).normal(0, 2, picture.shape).astype(np.float32)
    return silhouettes._explain_by_background(picture, background)


def test_a_shade_that_changes_smoothly_is_found_and_another_surface_is_not():
    x = np.linspace(0, 1, WIDTH, dtype=np.float32)[None, :, None]
    shade = np.broadcast_to(0.1 + 0.8 * x, (HEIGHT, WIDTH, 1)).astype(np.float32)
    by_background = explained(shade)
    assert np.abs(np.log(by_background.shade / shade[..., 0])).mean() < 0.1
    flat = np.full((HEIGHT, WIDTH, 3), (200, 60, 40), np.float32)
    other = silhouettes._explain_by_background(flat, stony().astype(np.float32))
    assert np.median(by_background.shaded) < 0.25 * np.median(other.cost)


@pytest.mark.parametrize(("cost", "stays"), [(1.3, True), (0.7, False)])
def test_a_disc_stays_where_its_area_outweighs_its_outline(cost, stays):
    """Of radius R, with a gain c inside and a length that costs 1 a pixel: pi R^2 c against 2 pi R."""
    radius = 12.0
    disc = ellipse((160, 120), radius, radius)[80:160, 120:200]
    gain = np.where(disc, -2 / radius * cost, 1.0).astype(np.float32)
    result = silhouettes._minimum_cost(gain, np.ones(gain.shape, np.float32))
    assert (result.sum() > 0.9 * disc.sum()) if stays else not result.any()


def test_half_covered_pixels_are_the_edge():
    """A disc whose first outline is a pixel too large all around, before a known background."""
    background = stony().astype(np.float32)
    fine = np.mgrid[: 4 * HEIGHT, : 4 * WIDTH] / 4 + 0.125
    whole = np.hypot(fine[1] - 160, fine[0] - 120) < 30
    cover = whole.reshape(HEIGHT, 4, WIDTH, 4).mean(axis=(1, 3))
    light = cover[..., None] * silhouettes.linear(np.float32([200, 60, 40])) + (
        1 - cover[..., None]
    ) * silhouettes.linear(background)
    first = cover > 0
    result = silhouettes._mixed(silhouettes.coded(light), background, np.ones(cover.shape, np.float32), first)
    wrong = (result != (cover >= 0.5)).sum()
    assert wrong < 0.05 * 2 * np.pi * 30 and wrong < 0.15 * (first != (cover >= 0.5)).sum()


def test_colours_are_learned_from_the_object_and_not_from_its_shadow():
    background = stony().astype(np.float32)
    body, dark = ellipse((120, 100), 30, 25), ellipse((120, 140), 30, 15)
    frame = np.where(dark[..., None], silhouettes.coded(0.08 * silhouettes.linear(background)), background)
    frame = np.where(body[..., None], (200, 60, 40), frame) + np.random.default_rng(1).normal(
        0, 2, background.shape
    )
    frame = np.clip(np.rint(frame), 0, 255).astype(np.uint8)
    palette = silhouettes.learn_palette([(frame, background, body | dark)])
    red = palette.colours[:, 0] > 2 * palette.colours[:, 1]
    assert palette.shares[red].sum() > 0.95 and palette.shares.sum() == pytest.approx(1)
    assert silhouettes.learn_palette([(frame, background, np.zeros(body.shape, bool))]) is None
    result = silhouettes.silhouette(frame, background, body | dark, palette)
    assert (result & body).sum() / (result | body).sum() > 0.97
