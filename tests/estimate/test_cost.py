"""What a hypothesis pays."""

import numpy as np
import pytest

from refield.estimate.cost import price, wrongness
from refield.estimate.explain import LIMIT


def test_a_pixel_costs_more_the_more_it_is_wrong():
    """As a square where a change is not told from the field's own errors, then as slowly as those become seldom."""
    times = np.array([0.0, 0.5, 1.0, 1.001, np.e, 10.0, 100.0])
    cost = wrongness(LIMIT * 6 * times, np.full(times.shape, 6.0))
    assert cost[:3].tolist() == [0.0, 0.25, 1.0]
    assert cost[3] == pytest.approx(1, abs=2e-3)
    assert cost[4] == pytest.approx(1.7) and cost[6] - cost[5] == pytest.approx(cost[5] - 1, rel=1e-3)


def test_a_body_pays_for_each_photo_that_shows_it():
    seen, unseen = np.eye(100, dtype=bool), np.zeros((100, 100), bool)
    assert price([], 0.003) == price([unseen], 0.003) == 0
    assert price([seen, unseen, seen], 0.003) == 2 * price([seen], 0.003) == pytest.approx(54)
    assert price([seen, unseen], 0.003, moved=True) == pytest.approx(9)  # a pose is six numbers, whatever its shape
