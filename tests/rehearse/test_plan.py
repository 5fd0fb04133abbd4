"""What is turned in a rehearsal looks otherwise afterwards."""

import numpy as np
import pytest

from refield.rehearse.plan import is_round
from refield.synthetic.random_objects import FAMILIES, drawn_item

ROUND = {"ball", "can", "pole", "cone", "tube", "bottle", "lamp"}


@pytest.mark.parametrize("family", [f for f in FAMILIES if f != "egg"])  # an egg may be nearly a ball
def test_what_is_round_is_known_by_its_shape(family):
    for seed in range(3):
        item = drawn_item(np.random.default_rng(seed), "thing", 0.3, family=family)[0]
        assert is_round(item.solid) == (family in ROUND)
