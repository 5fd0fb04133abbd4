"""Whether photos show an object in the light of its new place."""

import numpy as np
import pytest

from refield.estimate.explain import Compared, explained
from refield.scene.srgb import to_linear, to_srgb

SIZE = 48
PAINT = np.array([[0.75, 0.3, 0.55], [0.35, 0.1, 0.4]], np.float32)
"""a surface's two colours"""


@pytest.fixture
def pattern():
    """Patches of the two colours, (H, W, 3)."""
    patches = np.random.default_rng(1).integers(0, 2, (SIZE // 6, SIZE // 6))
    return PAINT[np.kron(patches, np.ones((6, 6), int))]


def share(photo, composite, background=0.5):
    """Part of the pixels that show what the composite does."""
    blank = np.full_like(photo, background)
    limit = np.full(photo.shape[:2], 4.0, np.float32)
    seen = Compared(photo, composite, blank, limit, np.zeros(photo.shape[:2], np.int64))
    return explained([seen], 8.0).part


@pytest.mark.parametrize("light", [(1, 1, 1), (0.4, 0.4, 0.4), (1.6, 1.6, 1.6), (0.45, 0.53, 0.62), (1.25, 1.05, 0.9)])
def test_light_may_be_brighter_and_tinted(pattern, light):
    photo = to_srgb(to_linear(pattern) * np.array(light, np.float32))
    assert share(photo, pattern) > 0.95


def test_another_paint_is_not_a_light(pattern):
    assert share(pattern[..., [1, 0, 2]], pattern) < 0.2


def test_another_pattern_is_not_a_light(pattern):
    assert share(pattern, np.rot90(pattern)) < 0.8
    assert share(pattern, np.broadcast_to(PAINT.mean(0), pattern.shape).copy()) < 0.3


def test_light_has_its_limits(pattern):
    black = to_srgb(to_linear(pattern) * 0.03)
    assert share(pattern, black) < 0.1


def test_colours_below_black_count_as_black(pattern):
    assert share(pattern, np.where(pattern < 0.2, -0.05, pattern)) == share(
        pattern, np.where(pattern < 0.2, 0, pattern)
    )
