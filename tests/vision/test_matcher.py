import numpy as np

from refield.vision import pixels
from refield.vision.matcher import SiftMatcher


def test_a_shifted_image_matches_by_its_shift():
    rng = np.random.default_rng(1)
    big = np.clip(pixels.blur(rng.random((160, 160, 3)).astype(np.float32), 1.5) * 5 - 2, 0, 1)
    big = (big * 255).astype(np.uint8)
    a, b, score = SiftMatcher().match(big[10:130, 10:130], big[17:137, 22:142])
    assert len(a) > 40 and (score > 0).all() and (score <= 1).all()
    np.testing.assert_allclose(np.median(a - b, axis=0), [12, 7], atol=0.1)
    assert (np.abs(a - b - [12, 7]).max(-1) < 1).mean() > 0.9


def test_a_featureless_image_matches_nothing():
    grey = np.full((64, 64, 3), 128, np.uint8)
    a, b, score = SiftMatcher().match(grey, grey)
    assert a.shape == b.shape == (0, 2) and score.shape == (0,)
