import numpy as np
import pytest

from refield.vision import pixels


def pattern(size=48, seed=0):
    rng = np.random.default_rng(seed)
    return pixels.blur(rng.random((size, size, 3)).astype(np.float32), 2.0) * 2 - 0.5


def test_a_shift_of_a_pixel_is_forgiven_and_a_change_is_not():
    image = np.clip(pattern(), 0, 1)
    shifted = np.roll(image, 1, axis=1)
    assert np.median(pixels.colour_difference(image, shifted, 0)[4:-4, 4:-4]) > 2
    assert pixels.colour_difference(image, shifted, 1)[4:-4, 4:-4].max() < 1e-3
    spot = image.copy()
    spot[20:26, 20:26] = (1, 0, 0)
    for a, b in ((image, spot), (spot, image)):
        found = pixels.colour_difference(a, b, 1) > 10
        assert found[21:25, 21:25].all() and not found[:15].any()


@pytest.mark.parametrize("reach", [0, 1, 2])
def test_the_difference_is_that_to_the_most_similar_pixel_near_by(reach):
    a, b = np.random.default_rng(0).random((2, 7, 9, 3)).astype(np.float32)
    lab = [pixels.to_lab(image) for image in (a, b)]
    padded = [np.pad(image, ((reach, reach), (reach, reach), (0, 0)), "edge") for image in lab]
    expected = np.zeros((7, 9))
    for i, j in np.ndindex(7, 9):
        windows = [p[i : i + 2 * reach + 1, j : j + 2 * reach + 1] for p in padded]
        one, two = (np.linalg.norm(lab[k][i, j] - windows[1 - k], axis=-1).min() for k in (0, 1))
        expected[i, j] = max(one, two)
    np.testing.assert_allclose(pixels.colour_difference(a, b, reach), expected, rtol=1e-5)


def test_exposure_is_fitted_though_a_third_of_the_pixels_changed():
    image = np.clip(pattern(64) * 0.7 + 0.1, 0.05, 0.8)
    gain, offset = np.array([1.2, 0.9, 1.05]), np.array([0.01, 0.0, -0.01])
    other = (image * gain + offset).astype(np.float32)
    other[:22] = (0.9, 0.1, 0.2)
    fit = pixels.fit_colours(image, other)
    np.testing.assert_allclose(image[30:] * fit[0] + fit[1], other[30:], atol=0.01)


@pytest.mark.parametrize(("gain", "texture"), [(1.1, 0.03), (1.6, 0.0), (0.6, 0.0)])
def test_exposure_is_fitted_though_more_than_half_changed(gain, texture):
    """Also of ground whose texture the field has not learnt: that is noise to it, along which a line would be flat."""
    rng = np.random.default_rng(1)
    ground = np.array([0.25, 0.45, 0.5]) + 0.03 * rng.standard_normal((64, 64, 1))
    photo = ground + texture * rng.standard_normal((64, 64, 1))
    field = gain * ground
    for other in (photo, field):
        other[:42] = np.clip(0.5 + 0.2 * rng.standard_normal((42, 64, 3)), 0.05, 0.95)
    told, offset = pixels.fit_colours(photo, field)
    assert np.abs((photo * told + offset - field)[42:].mean((0, 1))).max() < 0.01
    assert np.abs(told / gain - 1).max() < (0.3 if texture else 0.02)


def test_exposure_is_not_taken_from_one_even_thing():
    """However alike its pixels are: more lie about the gain of the ground."""
    rng = np.random.default_rng(2)
    ground = np.full((64, 64, 3), 0.4)
    photo = ground * np.exp(0.06 * rng.standard_normal((64, 64, 1)))
    photo[:20], ground[:20] = 0.5, 0.4
    gain, offset = pixels.fit_colours(photo, ground)
    assert np.abs((photo * gain + offset - ground)[20:].mean((0, 1))).max() < 0.02


def test_exposure_stays_when_there_is_nothing_to_fit():
    black = np.zeros((8, 8, 3), np.float32)
    np.testing.assert_array_equal(pixels.fit_colours(black, black), [[1, 1, 1], [0, 0, 0]])


def test_otsu_falls_between_two_groups():
    values = np.concatenate([np.full(500, 3.0), np.full(200, 30.0)]).astype(np.float32)
    assert 3 <= pixels.otsu(values, 60.0) < 30


def test_holes_and_specks():
    mask = np.zeros((20, 20), bool)
    mask[4:14, 4:14] = True
    mask[8:10, 8:10] = False
    mask[17, 17] = True
    filled = pixels.fill_holes(mask, 6)
    assert filled[8, 8] and not filled[0, 0] and not pixels.fill_holes(mask, 3)[8, 8]
    assert not pixels.keep_components(mask, 4)[17, 17]
    seeds = np.zeros_like(mask)
    seeds[17, 17] = True
    assert pixels.keep_components(mask, 1, seeds).sum() == 1


def test_bounding_box_is_clipped_and_may_be_none():
    mask = np.zeros((10, 12), bool)
    assert pixels.bounding_box(mask) is None
    mask[3:5, 7:12] = True
    assert pixels.bounding_box(mask) == (7, 3, 12, 5)
    assert pixels.bounding_box(mask, 2) == (5, 1, 12, 7)


@pytest.mark.parametrize("steps", [1, 2])
def test_growing_then_shrinking_a_square_gives_it_back(steps):
    mask = np.zeros((16, 16), bool)
    mask[5:9, 6:10] = True
    np.testing.assert_array_equal(pixels.erode(pixels.dilate(mask, steps), steps), mask)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_the_median_leaves_out_what_is_unknown(count):
    rng = np.random.default_rng(count)
    images = rng.normal(size=(count, 9, 7)).astype(np.float32)
    images[rng.random(images.shape) < 0.4] = np.nan
    images[0, 0], images[:, 1, 1] = 1, np.nan
    told = pixels.median(images)
    some = np.isfinite(images).any(0)
    assert not some[1, 1] and np.isnan(told[~some]).all()
    np.testing.assert_allclose(told[some], np.nanmedian(images[:, some], 0))
