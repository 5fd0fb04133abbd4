"""The gauntlet's own arithmetic, and that whatever happens to a scene becomes its row."""

from __future__ import annotations

import importlib
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch

from refield.rehearse.matching import matched
from refield.scene.change import ObjectChange, OccupancyGrid
from refield.scene.errors import InputError
from refield.scene.files import read_json
from refield.scene.transforms_json import load_transforms
from tests.captures import write_capture

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def part(monkeypatch: pytest.MonkeyPatch) -> Iterator:
    """Imports a part of the gauntlet by name."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    before = set(sys.modules)

    def named(name: str) -> ModuleType:
        return importlib.import_module(f"gauntlet.{name}")

    yield named
    for name in set(sys.modules) - before:
        if str(BENCHMARKS) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def box(kind: str, x: float, to: float | None = None) -> ObjectChange:
    """A cube of 0.4 at x, moved to ``to``."""
    middle = torch.tensor([x, 0.0, 0.2])
    grid = OccupancyGrid(torch.stack([middle - 0.2, middle + 0.2]), torch.ones(9, 9, 9))
    motion = torch.eye(4, dtype=torch.float64)
    motion[0, 3] = 0.0 if to is None else to - x
    return ObjectChange(kind, grid, None if to is None else motion)  # type: ignore[arg-type]


def test_objects_are_matched_by_place() -> None:
    true = [box("moved", 0.0, 2.0), box("removed", -2.0)]
    right = matched([box("removed", -2.05), box("moved", 0.05, 2.0)], true)
    assert (right.pairs, right.pieces, right.false) == ({0: 1, 1: 0}, (), ())
    # what moved taken for one that left and one that came: one of them is it, the other a piece; far off is false
    split = matched([box("removed", 0.0), box("added", 2.0), box("added", 5.0)], true)
    assert list(split.pairs) == [0] and split.missed(len(true)) == 1
    assert len(split.pieces) == 1 and split.false == (2,)


def test_pose_errors_are_told_by_distance(part) -> None:
    cameras = torch.tensor([[2.0, 0.0, 3.2]], dtype=torch.float64)
    row = part("match").pose_row(box("moved", 0.0, 2.03), box("moved", 0.0, 2.0), cameras)
    assert row["off"] == pytest.approx(0.03, abs=1e-6)
    assert row["off, % of distance"] == pytest.approx(1.0, abs=1e-3)
    assert row["off, °"] == pytest.approx(0.0, abs=1e-4)


def test_turns_that_cannot_be_seen_are_known(part) -> None:
    things = [
        ("ball", "plain", "added"),
        ("can", "dotted", "moved"),
        ("box", "plain", "none"),
        ("cone", "plain", "tipped"),
    ]
    facts = {"objects": [{"family": f, "texture": t, "change": c} for f, t, c in things]}
    symmetric = part("row").symmetric
    assert symmetric(facts, 3) == {1, 2}  # in the order of the truth: can, cone, and what arrived
    assert symmetric({}, 3) == symmetric(facts, 2) == set()


def test_wilson_interval_is_the_published_one(part) -> None:
    lo, hi = part("summary").wilson(15, 148)  # Newcombe 1998, Table I: 0.0624 to 0.1605
    assert (lo, hi) == (pytest.approx(0.0624, abs=5e-5), pytest.approx(0.1605, abs=5e-5))


def test_a_seed_is_reported_on_once(part, tmp_path: Path) -> None:
    path = tmp_path / "use.json"
    ledger = part("ledger").Ledger
    ledger(path).claim([3, 1000], again=False)
    ledger(path).claim([3], again=False)
    with pytest.raises(InputError, match="reported on before"):
        ledger(path).claim([999, 1000], again=False)
    ledger(path).claim([1000], again=True)
    with pytest.raises(InputError, match="neither for developing"):
        ledger(path).claim([4000], again=True)
    assert ledger(path).runs == {3: 2, 1000: 2}
    ledger(path, "rehearsals").claim([1000], again=False)
    assert ledger(path).runs == {3: 2, 1000: 2} and ledger(path, "rehearsals").runs == {1000: 1}
    assert ledger(path).told([3, 1000]).count("2 times") == 2


def test_commands_are_watched(part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chain = part("chain")
    one = chain.Chain(tmp_path)
    assert one.run("version", "--version")
    assert not one.run("train", "train", tmp_path / "nowhere", tmp_path / "work")
    assert not one.run("no such option", "train", "--nonsense")

    def broken(arguments: list[str]) -> int:
        raise ValueError("of two minds")

    monkeypatch.setattr(chain, "refield", broken)
    assert not one.run("update", "update")
    assert [r["how"] for r in one.ran] == [None, "refused", "refused", "crashed"]
    assert "nowhere" in one.ran[1]["why"] and one.ran[3]["why"] == "ValueError: of two minds"
    assert "of two minds" in (tmp_path / "logs" / "3_update.txt").read_text()
    assert chain.failure(chain.commands_of(tmp_path))["command"] == "train"


def test_scenes_past_their_time_are_rows(part, tmp_path: Path) -> None:
    drive, trials = part("drive"), part("trials")
    options = drive.Options(tmp_path / "out", jobs=2, limit=0.2)
    scenes = trials.named_worlds(["cube", "cone"])
    drive.run_all(scenes, options)
    rows = [read_json(options.folder(trial) / "row.json") for trial in scenes]
    assert [(row["failed"]["how"], row["cores"]) for row in rows] == [("stopped", 1)] * 2
    began = (options.folder(scenes[0]) / "row.json").stat().st_mtime_ns
    drive.run_all(scenes, options)  # what is finished is not run again
    assert (options.folder(scenes[0]) / "row.json").stat().st_mtime_ns == began
    text = drive.tell(scenes, [], options, part("ledger").Ledger(tmp_path / "use.json"))
    assert "2 of 2" in text and (options.out / "worst.png").is_file()


def test_the_worst_come_first(part) -> None:
    badness = part("summary").badness
    rows = [
        {"failed": {"how": "crashed"}},
        {"failed": {"how": "refused"}, "psnr": 40.0},
        {"failed": None, "right": False, "psnr_in": 35.0},
        {"failed": None, "right": True, "psnr_in": 20.0, "psnr_out": 34.0},
        {"failed": None, "right": True, "psnr_in": 30.0},
    ]
    assert sorted(rows[::-1], key=badness, reverse=True) == rows


def test_photos_of_one_visit_are_old_and_new_ones(part, tmp_path: Path) -> None:
    write_capture(tmp_path / "photos", 12)
    chain, trials = part("chain").Chain(tmp_path), part("trials")
    trial = trials.Trial("still", "nothing changed", None, str(tmp_path / "photos"))
    data = trials.make(trial, chain)
    counts = [len(load_transforms(data / name, decode=False).frames) for name in ("before", "after", "eval")]
    assert counts == [4, 4, 4] and part("match").true_objects(data) == ()


def test_what_is_not_there_is_left_out_with_a_reason(part, tmp_path: Path) -> None:
    (tmp_path / "plush").mkdir()
    trials, skipped = part("trials").chosen([7], [], tmp_path)
    assert [t.source for t in trials] == ["nothing changed", "rehearsal"] and trials[1].seed == 7
    assert len(skipped) == 5 and all("is not there" in line for line in skipped)


def test_a_sequence_is_split_evenly(part) -> None:
    old, new, evaluation = part("trials")._parts(67)
    assert sorted([*old, *new, *evaluation]) == list(range(67))
    assert len(new) == len(evaluation) == 4
    assert min(b - a for a, b in itertools.pairwise(new)) >= 16
