from refield.estimate.tally import Tally


def test_what_was_made_only_grows_whatever_is_known_to_come():
    told: list[tuple[int, int]] = []
    tally = Tally(lambda done, total: told.append((done, total)))
    tally.begin(2)
    tally.count(1)
    tally.count(4)  # something was found, and more is asked beside that
    tally.count(0)
    assert told == [(0, 2), (1, 2), (2, 6), (3, 3)]


def test_nobody_needs_to_listen():
    Tally().count(1)
