"""Whose outline is cut in two: what no whole thing explains."""

from __future__ import annotations

from contextlib import suppress
from itertools import count
from types import SimpleNamespace

import pytest

from refield.estimate import associate, fit
from refield.estimate.explain import Explained
from refield.estimate.fit import Fit
from refield.estimate.ground import AssociateConfig
from refield.estimate.pose_change import RefineConfig
from refield.estimate.register import RegisterConfig
from refield.estimate.tally import Tally

A, B, C = 0, 1, 2
CERTAIN, WEAK, NOWHERE = 0.9, 0.6, None


class Placed(Exception):
    """What fits would be placed now."""


def asked_to_be_cut(monkeypatch, wholes, left=("a newcomer",), remembered=()):
    """The outlines that are asked of in the first round, in order; ``wholes``: what each one's fit explains."""
    asked = []
    olds = {k: SimpleNamespace(key=k, remembered=k in remembered) for k in wholes}

    def fit_of(ground, old, *_):
        share = wholes[old.key]
        return None if share is None else Fit(0.1, old, SimpleNamespace(explained=share))

    def cut_of(ground, old, whole, *_):
        assert (whole is None) == (wholes[old.key] is None)
        asked.append(old.key)

    def place(*_):
        raise Placed

    for name, stand_in in {
        "fit_of": fit_of,
        "cut_of": cut_of,
        "fit_again": lambda *_: None,
        "newcomers": lambda *_: ["a part"],
        "remarkable": lambda *_: list(left),
        "places_of": lambda *_: [],
        "matched_poses": lambda *_: [],
        "is_among": lambda *_: False,
        "_together": place,
    }.items():
        monkeypatch.setattr(associate, name, stand_in)
    ground = SimpleNamespace(believe=AssociateConfig(), search=RegisterConfig(), survey=(), matcher=None, tally=Tally())
    with suppress(Placed):
        associate._place(ground, olds, list(olds), [], (count(9), {k: [] for k in olds}))
    return asked


@pytest.mark.parametrize(
    ("wholes", "asked"),
    [
        ({A: CERTAIN, B: WEAK, C: NOWHERE}, []),  # it may explain what arrived
        ({A: WEAK, B: WEAK, C: NOWHERE}, [A, B]),
        ({A: NOWHERE, B: NOWHERE}, [A, B]),
    ],
)
def test_an_outline_is_cut_only_for_what_no_whole_thing_explains(monkeypatch, wholes, asked):
    assert asked_to_be_cut(monkeypatch, wholes) == asked


def test_nothing_is_cut_where_nothing_is_left_to_explain(monkeypatch):
    assert asked_to_be_cut(monkeypatch, {A: WEAK}, left=()) == []


def test_what_is_known_from_earlier_is_never_cut(monkeypatch):
    assert asked_to_be_cut(monkeypatch, {A: WEAK, B: NOWHERE}, remembered=(A,)) == []


@pytest.mark.parametrize(
    ("told", "one_alone"),
    [
        ((Explained(0.9, 0, 400), Explained(0.3, 0, 400)), True),
        ((Explained(0.9, 0, 400), Explained(0.85, 0, 400)), False),  # badly lit, on either side
        ((Explained(0.7, 0, 400), Explained(0.5, 0, 400)), False),  # badly shown by the field
        ((Explained(0.9, 0, 400), Explained(0.3, 0, 10)), False),  # hidden: nothing is known of it
    ],
)
def test_an_outline_that_fits_is_cut_where_one_side_alone_is_shown(monkeypatch, told, one_alone):
    sides = SimpleNamespace(), SimpleNamespace()
    ready = SimpleNamespace(apparent=10.0, explained_of=lambda asked, *_: list(told))
    monkeypatch.setattr(fit, "layers_at", lambda *_: ready)
    monkeypatch.setattr(fit, "detail_for", lambda *_: None)
    whole = Fit(0.1, SimpleNamespace(), SimpleNamespace(new_from_old=None))
    ground = SimpleNamespace(field=None, fine=RefineConfig(), believe=AssociateConfig())
    assert fit._shows_one_side(ground, whole, sides, [], []) == one_alone
