"""A rehearsal's score: what was found is told rightly, wrongly, not at all, or is there too much."""

import numpy as np
import pytest
import torch

from refield.commands.rehearse import seeds_of
from refield.rehearse.score import score_change
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.errors import InputError
from refield.scene.pose import exp
from refield.synthetic.placing import box_item


def change(kind, x=0.0, shift=0.5, turn=0.0):
    item = box_item(np.random.default_rng(0), "box", (0.1, 0.1, 0.1), 0.3, (x, 0.0, 0.0))
    pose = None
    if kind == "moved":
        pose = torch.eye(4, dtype=torch.float64)
        pose[1, 3] = shift
        middle = item.box().mean(0)
        spin = exp(torch.tensor([0, 0, 0, 0, 0, np.deg2rad(turn)], dtype=torch.float64))
        pose[:3, :3] = spin[:3, :3]
        pose[:3, 3] += middle - spin[:3, :3] @ middle
    return ObjectChange(kind, item.grid(), pose)


def of(*objects):
    return SceneChange(objects=objects)


def test_a_moved_object_is_measured():
    score = score_change(of(change("moved", 0.02, 0.5, 5.0)), of(change("moved")))
    (o,) = score.objects
    assert score.all_right and o.turn_error_deg == pytest.approx(5.0, abs=1e-4)
    assert o.shift_error < 0.01


def test_kinds_too_many_and_too_few():
    score = score_change(of(change("added", 0.0), change("removed", 2.0)), of(change("removed"), change("moved", 5.0)))
    assert [o.found for o in score.objects] == [None, None] and score.extra == ("added", "removed")
    assert not score.all_right and score.right == 0
    score = score_change(of(change("removed", 0.05)), of(change("moved")))
    assert [o.found for o in score.objects] == ["removed"] and score.extra == () and not score.all_right


def test_a_neighbour_does_not_take_what_is_anothers():
    score = score_change(of(change("removed", 0.1)), of(change("removed", 0.0), change("removed", 0.1)))
    assert [o.found for o in score.objects] == [None, "removed"] and score.extra == ()


def test_nothing_found_where_nothing_is_is_right():
    assert score_change(of(), of()).all_right
    assert not score_change(of(change("added")), of()).all_right


@pytest.mark.parametrize("text, seeds", [("3", [3]), ("0..2", [0, 1, 2]), (" 5..5 ", [5])])
def test_seeds(text, seeds):
    assert seeds_of(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "2..1", "1-3", "0..1000", "-1"])
def test_no_seeds(text):
    with pytest.raises(InputError, match="--seeds"):
        seeds_of(text)


def test_seeds_the_wrong_way_round_are_put_right():
    with pytest.raises(InputError, match=r"ends before it begins; give 2\.\.5"):
        seeds_of("5..2")
