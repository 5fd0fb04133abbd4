"""A texture that goes on where nobody has seen it: in its own pattern, and no further than it has one."""

import numpy as np
import pytest

from refield.update.pattern import continued

SIDE = 120
U, V = np.mgrid[:SIDE, :SIDE]
HIDDEN = np.zeros((SIDE, SIDE), bool)
HIDDEN[45:75, 50:85] = True


def tiles(rng, spread=0.03):
    """Tiles of 13 x 17 texels with dark seams, each of a shade of its own, in light that changes slowly."""
    shade = 0.6 + spread * rng.standard_normal((SIDE, SIDE))
    base = np.where((U % 13 < 2) | (V % 17 < 2), 0.3, shade[U // 13, V // 17])
    return (base * (0.8 + 0.3 * V / SIDE))[..., None] * np.array([1.0, 0.8, 0.6])


def covered(picture):
    """The picture, its hidden part replaced by the mean of the rest."""
    return np.where(HIDDEN[..., None], picture[~HIDDEN].mean(0), picture)


def error(found, truth):
    return float(np.square(found - truth)[HIDDEN].mean())


def test_a_pattern_goes_on():
    truth = tiles(np.random.default_rng(0))
    smooth = covered(truth)
    found = continued(smooth, ~HIDDEN, HIDDEN)
    assert error(found, truth) < 0.1 * error(smooth, truth)
    assert np.array_equal(found[~HIDDEN], truth[~HIDDEN]) and found.min() >= 0 and found.max() <= 1


def test_the_less_it_repeats_the_less_is_believed():
    rng = np.random.default_rng(1)
    for spread in (0.05, 0.15, 0.3):
        truth = tiles(rng, spread).clip(0, 1)
        assert error(continued(covered(truth), ~HIDDEN, HIDDEN), truth) < error(covered(truth), truth)


@pytest.mark.parametrize("grain", [1, 8])
def test_what_has_no_pattern_stays_as_smooth_as_it_was(grain):
    rng = np.random.default_rng(2)
    small = rng.uniform(size=(SIDE // grain, SIDE // grain, 3))
    smooth = covered(np.kron(small, np.ones((grain, grain, 1))) if grain > 1 else small)
    assert np.array_equal(continued(smooth, ~HIDDEN, HIDDEN), smooth)


def test_what_is_not_known_is_not_taken_for_the_pattern():
    truth = tiles(np.random.default_rng(3))
    known = ~HIDDEN
    known[:, :20] = False
    spoilt = covered(truth)
    spoilt[:, :20] = 1.0
    found = continued(spoilt, known, HIDDEN)
    assert error(found, truth) < 0.15 * error(covered(truth), truth)
    assert (found[:, :20] == 1).all()
