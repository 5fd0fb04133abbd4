from refield.estimate.tally import Tally


def test_what_is_known_to_come_grows_and_shrinks_and_what_was_made_does_not():
    told: list[tuple[int, int]] = []
    tally = Tally(lambda done, total: told.append((done, total)))
    tally.expect(3)
    tally.count()
    tally.count()
    tally.expect(5)  # something was found, and all is asked beside that
    tally.count()
    tally.expect(0)
    tally.count()
    assert told == [(1, 3), (2, 3), (3, 7), (4, 4)]


def test_nobody_needs_to_listen():
    Tally().count()
