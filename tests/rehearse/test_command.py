"""`refield rehearse`: what is done is told whatever comes after it."""

import json

import pytest
import torch

from refield.commands import rehearse
from refield.commands.answer import told
from refield.commands.rehearse import Rehearse, Rehearsed
from refield.field.fit import FitConfig
from refield.rehearse.plan import NoRoomError
from refield.rehearse.score import score_change
from refield.scene.change import SceneChange

FACTS = {"happening": "nothing", "changes": []}


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs the command; rehearsals take no time, and those of which an outcome is given end in it."""

    def go(seeds, outcomes, as_json=False):
        def rehearsed(scenery, folder, seed, clock, options):
            folder.mkdir()
            if seed in outcomes:
                raise outcomes[seed]
            score = score_change(SceneChange(), SceneChange())
            return [Rehearsed(seed, FACTS, 30.0, score, None, "", 1.0)]

        monkeypatch.setattr(rehearse, "prepared", lambda *_: (None, 1.0))
        monkeypatch.setattr(rehearse, "rehearsed", rehearsed)
        asked = Rehearse(tmp_path / "work", seeds, tmp_path / "out", fit=FitConfig())
        told(lambda: rehearse.run(asked), as_json=as_json)

    return go


def test_one_that_there_is_no_room_for_is_left_out(run, tmp_path, capsys):
    run("0..2", {1: NoRoomError("the rehearsal", "there is no free place", "give others")})
    said = capsys.readouterr()
    assert "rehearsal 1 is left out" in said.err and "2 of 2 rehearsals" in said.out
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["000", "002", rehearse.REPORT]


def test_where_there_is_no_room_for_any_that_is_the_answer(run, capsys):
    fault = NoRoomError("the rehearsal", "there is no free place", "give others")
    with pytest.raises(NoRoomError):
        run("0..1", {0: fault, 1: fault})
    assert "rehearsals with" not in capsys.readouterr().out


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), torch.OutOfMemoryError("no memory")])
def test_what_is_done_is_told_when_it_is_interrupted(run, tmp_path, capsys, fault):
    with pytest.raises(type(fault)):
        run("0..2", {1: fault})
    assert "1 of 1 rehearsals" in capsys.readouterr().out
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["000", rehearse.REPORT]


def test_programs_are_told_what_is_done_and_why_there_is_no_more(run, capsys):
    with pytest.raises(KeyboardInterrupt):
        run("0..2", {1: KeyboardInterrupt()}, as_json=True)
    document = json.loads(capsys.readouterr().out)
    assert [r["seed"] for r in document["rehearsals"]] == [0] and document["error"]["what"] == "interrupted"


def test_changes_of_a_rehearsal_that_are_done_are_told_when_the_next_is_interrupted(run, monkeypatch, tmp_path, capsys):
    def two(scenery, folder, seed, clock, options):
        folder.mkdir()
        yield Rehearsed(seed, FACTS, 30.0, score_change(SceneChange(), SceneChange()), None, "", 1.0, 0)
        raise KeyboardInterrupt

    run("0", {})
    monkeypatch.setattr(rehearse, "rehearsed", two)
    asked = Rehearse(tmp_path / "work", "0", tmp_path / "other", changes=2, fit=FitConfig())
    capsys.readouterr()
    with pytest.raises(KeyboardInterrupt):
        told(lambda: rehearse.run(asked), as_json=False)
    assert "1 of 1 changes" in capsys.readouterr().out
    assert (tmp_path / "other" / "000").is_dir()  # what is told of is kept
    (one,) = json.loads((tmp_path / "other" / rehearse.REPORT).read_text())["rehearsals"]
    assert (one["seed"], one["number"]) == (0, 0)
