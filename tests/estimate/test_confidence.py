"""How sure what is told is: by the lead over the best other answer."""

from __future__ import annotations

import math

import pytest

from refield.estimate.confidence import confidence


@pytest.mark.parametrize("kind", ["moved", "removed", "added"])
def test_it_grows_with_the_lead_and_is_never_certain(kind):
    sure = [confidence(kind, lead, False) for lead in (-1.0, 0.0, 0.1, 0.2, 0.5, 0.8, math.inf)]
    assert sure == sorted(sure) and sure[0] < (0.4 if kind == "moved" else 0.01) and 0.9 < sure[-1] < 0.95


def test_what_left_where_something_arrived_may_have_moved():
    for kind in ("removed", "added"):
        assert confidence(kind, 1.0, True) < 0.5 < confidence(kind, 1.0, False)
