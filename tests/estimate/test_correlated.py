"""How many pixels count as one, of noise whose correlation is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from refield.estimate.correlated import pixels_as_one


def noise(*shape):
    return np.random.default_rng(shape[0]).standard_normal(shape).astype(np.float32)


def test_independent_pixels_count_each():
    assert pixels_as_one([noise(60, 80, 3), noise(50, 40, 3)]) == pytest.approx(1, abs=0.3)


@pytest.mark.parametrize("sigma", [1.5, 3.0])
def test_blurred_noise(sigma):
    """Its autocorrelation is exp(-d² / 4σ²), whose square sums to 2πσ²."""
    # chance adds one part in as many as there are pictures and channels, and edges take some
    pictures = [gaussian_filter(noise(90 + i, 120, 3), (sigma, sigma, 0)) for i in range(8)]
    assert pixels_as_one(pictures) == pytest.approx(2 * np.pi * sigma**2, rel=0.2)


def test_a_picture_of_one_error_is_one_pixel():
    assert pixels_as_one([np.ones((30, 20, 3), np.float32)]) > 200


def test_nothing_to_measure():
    assert pixels_as_one([]) == pixels_as_one([np.zeros((5, 5, 3), np.float32)]) == 1.0
