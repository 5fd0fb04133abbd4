"""How much a browser is given to draw."""

from itertools import count, pairwise

import pytest

from refield.view.pace import DETAILS, PICTURE, Pace


def moved(pace, now, seconds, pictures=40):
    """So many pictures, each of which takes a time that depends on what is drawn; when the last came, and what was
    drawn."""
    pace.set_out()
    drawn = []
    for _ in range(pictures):
        now += seconds(pace.detail)
        drawn.append(pace.detail)
        pace.picture(now)
    return now, drawn


@pytest.mark.parametrize(
    ("seconds", "ends"),
    [
        (lambda detail: 0.016, DETAILS[3]),  # on a graphics card
        (lambda detail: 0.02 + (0.7 if detail.kind == "splats" else 0.05 * detail.part), DETAILS[2]),
        (lambda detail: 0.02 + (1.4 if detail.kind == "splats" else 0.12 * detail.part), DETAILS[1]),
        (lambda detail: 0.4, DETAILS[0]),
    ],
)
def test_what_is_drawn_follows_the_machine(seconds, ends):
    pace, now = Pace(), 0.0
    for _ in range(8):
        now, drawn = moved(pace, now, seconds)
        assert all(DETAILS.index(b) <= DETAILS.index(a) for a, b in pairwise(drawn))  # more only while it stands
        pace.rests(now)
        now += 1.0
    assert pace.detail == ends
    assert seconds(ends) <= PICTURE or ends == DETAILS[0]


def test_what_was_too_much_is_not_tried_again_soon():
    pace, now = Pace(), 0.0
    tried = []
    for _ in range(200):  # moves of a second with a second between them
        now, drawn = moved(pace, now, lambda detail: 0.4 if detail.kind == "splats" else 0.02, 12)
        if DETAILS[3] in drawn:
            tried.append(now)
        pace.rests(now)
        now += 1.0
    assert len(tried) >= 2 and all(b - a > 25 for a, b in pairwise(tried))
    gaps = [b - a for a, b in pairwise(tried)]
    assert gaps == sorted(gaps)


def test_pauses_are_no_slow_pictures():
    pace = Pace()
    now, _ = moved(pace, 0.0, lambda detail: 0.03)
    assert pace.detail == DETAILS[0] and pace.rests(now) and pace.detail == DETAILS[2]
    pace.set_out()
    for i in count():
        pace.picture(now)
        now += 0.8 if i % 5 == 4 else 0.016  # somebody turns a wheel
        if i == 60:
            break
    assert pace.detail == DETAILS[2]
    assert not any(pace.picture(now) for _ in range(9))  # one message that is told to several threads


def test_a_slow_browser_is_given_time():
    pace = Pace()
    at_first = pace.rest
    now, _ = moved(pace, 0.0, lambda detail: 0.3)
    assert pace.rest > 3 * 0.3 > at_first
    pace.rests(now)
    assert pace.rest == at_first
    moved(pace, now, lambda detail: 0.01)
    assert pace.rest == at_first
