"""Results that are asked for again."""

from refield.estimate.kept import Kept


def test_results_are_kept_by_identity():
    kept, made = Kept[list[int] | None](), []

    def of(*things: object) -> list[int] | None:
        return kept.get(things, lambda: made.append(1))

    a, b = [1], [1]
    assert of(a, None) is None and of(a, None) is None and len(made) == 1  # nothing is a result as well
    of(b, None)
    of(None, a)
    assert len(made) == 3


def test_the_oldest_are_forgotten_and_no_other_answers_for_them():
    kept, things, made = Kept[int](2), [[k] for k in range(3)], []
    for k in (0, 1, 0, 2, 0, 1):  # 1 goes when 2 comes
        kept.get((things[k],), lambda k=k: made.append(k) or k)
    assert made == [0, 1, 2, 1]
