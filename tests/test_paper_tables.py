"""The paper's tables: the transcription holds together, results are kept, and what is shown is what was found."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch

from refield.scene.files import write_json
from refield.scene.images import write_image
from refield.update.config import UpdateConfig
from refield.update.fit_helper import HelperConfig
from refield.update.relight import RelightConfig
from refield.update.train import update_field
from tests.baselines.test_baselines import capture, change, old
from tests.captures import write_capture

__all__ = ["capture", "change", "old"]  # fixtures
BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
SCRIPTS = ("tables", "estimate", "record", "change_score", "paper_tables", "departures", "retraining", "grounds")
MEASURES = ("psnr", "ssim", "psnr_in", "ssim_in", "lpips_in", "psnr_out", "ssim_out", "lpips_out", "psnr_untouched")


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Any]]:
    """Imports a module of the benchmark as its script does."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if name.split(".")[0] in SCRIPTS:
            del sys.modules[name]


def test_the_transcription_holds_together(tables: Callable[[str], Any]) -> None:
    paper = tables("tables.paper")
    assert set(paper.TABLE_3) == {*paper.REAL, *paper.SYNTHETIC}
    for rows in paper.TABLE_3.values():
        assert set(rows) == {"ours", "retrain", "lama"} and all(len(r) == 7 for r in rows.values())
        assert rows["lama"][:3] == (None, None, None)
    assert set(paper.TABLE_5_NO_REFINE) == set(paper.TABLE_5_NO_ADJACENT) == set(paper.TABLE_3)
    assert set(paper.TABLE_6) == set(paper.SYNTHETIC)
    assert all(tuple(r) == (1, 2, 3, 4, 8, 12, 16) for r in paper.TABLE_7.values())
    cube = paper.TABLE_3["cube"]
    assert paper.TABLE_8["same views, same evaluation"] == cube["ours"][:6]
    assert paper.TABLE_8["re-trained"] == cube["retrain"][:6]
    # "If we only consider the training time, our update training is about 20 to 60 times faster" (§5.4)
    ratios = [again / ours for ours, again in paper.TABLE_1_TRAIN_SECONDS.values()]
    assert min(ratios) > 19 and max(ratios) < 60


def test_a_result_is_found_again_and_a_damaged_one_is_not(tables: Callable[[str], Any], tmp_path: Path) -> None:
    kept, runs = tables("tables.kept").Kept(tmp_path), []

    def run() -> dict[str, Any]:
        runs.append(1)
        return {"train": 2.5}

    first = kept.once("cube", "ours", run)
    assert kept.once("cube", "ours", run) == first and len(runs) == 1
    assert first["train"] == 2.5 and {"date", "machine", "threads", "versions"} <= set(first["made"])
    kept.path("cube", "ours").write_text("{ cut off")
    assert kept.once("cube", "ours", run)["train"] == 2.5 and len(runs) == 2
    with pytest.raises(KeyboardInterrupt):
        kept.once("cube", "retrained", interrupted)
    assert kept.get("cube", "retrained") is None


def interrupted() -> dict[str, Any]:
    raise KeyboardInterrupt


def scores(psnr_out: float, psnr_in: float) -> dict[str, Any]:
    one = dict.fromkeys(MEASURES) | {"psnr": 30.0, "ssim": 0.9, "psnr_out": psnr_out, "psnr_in": psnr_in}
    return {"scores": {"as rendered": one, "aligned": one}}


def results(out: Path, case: str) -> None:
    """As if the methods had been run."""
    stages = {"detect": 3.0, "hull": 1.0, "pose": 2.0, "segment": 1.0}
    curve = [{"step": s, "seconds": t, "scores": {"psnr": p, "ssim": 0.9, "psnr_out": p, "psnr_in": p - 9}}
             for s, t, p in ((10, 1.0, 15.0), (100, 10.0, 28.0), (200, 20.0, 29.0))]  # fmt: skip
    records: dict[str, dict[str, Any]] = {
        "estimate": {"seconds": stages, "total": 7.0, "why": "", "objects": []},
        "ours": scores(28.0, 27.0)
        | {"seconds": {"move": 1.0, "train": 2.0}, "train": 3.0, "why": "all steps done", "curve": curve[:2]},
        "retrained": scores(29.0, 20.0) | {"train": 20.0, "steps": 200, "curve": curve},
        "finetuned": scores(22.0, 18.0) | {"train": 15.0, "steps": 200, "curve": curve},
        "old": scores(14.0, 13.0),
        "inpainted": scores(16.0, 13.0),
        "inpainted_photo": scores(18.0, 50.0),
    }
    made = {"date": "2026-11-21", "machine": "2 cores", "threads": 2, "versions": "torch"}
    for method, record in records.items():
        write_json(out / "results" / case / f"{method}.json", record | {"made": made, "load": 0.5})
        if method not in ("estimate",):
            write_image(out / "pictures" / case / method / "0000.png", torch.rand(24, 32, 3))


def folder(path: Path) -> Path:
    """A case's photos; nothing is run, so that there need be no field."""
    (path / "work").mkdir(parents=True)
    write_capture(path / "after", 2)
    write_capture(path / "eval", 1)
    mask = torch.zeros(24, 32, dtype=torch.bool)
    mask[5:15, 5:20] = True
    for kind in ("masks_in", "masks_out"):
        write_image(path / "eval" / kind / "000.png", mask)
    return path


def test_what_was_found_is_shown(
    tables: Callable[[str], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script, cases = tables("paper_tables"), tables("tables.cases")
    mine, docs = folder(tmp_path / "mine"), tmp_path / "docs" / "results.md"
    results(tmp_path / "out" / f"steps_{script.FitConfig.steps}_{script.HelperConfig.steps}", "mine")
    monkeypatch.setattr(cases.Case, "frames", write_capture(tmp_path / "new", 2).frames)
    docs.parent.mkdir()
    docs.write_text("# Results\n\nOther figures.\n")
    argv = ["paper_tables.py", "--only", "table3", "--folders", str(mine), "--out", str(tmp_path / "out")]
    argv += ["--threads", str(torch.get_num_threads())]  # which the script sets for its whole process
    monkeypatch.setattr(sys, "argv", [*argv, "--docs", str(docs)])
    assert script.main() == 0
    assert "0 runs are missing" in capsys.readouterr().out
    text = docs.read_text()
    row = next(line for line in text.splitlines() if "| **ours** |" in line)
    cells = [c.strip() for c in row.split("|")]
    assert cells[1] == "mine" and "27.00" in cells and "28.00" in cells and "10.0" in cells  # estimate and update
    late = [line.split("|") for line in text.splitlines() if "| mine | PSNR-" in line]
    assert [c[7].strip() for c in late] == ["10.0", "≥ 20.0"]  # when it was first as good
    assert [c[9].strip() for c in late] == ["1", "≥ 2"]  # of ten seconds
    assert "| pose change | 2.0 | 10.7 |" in text
    photo = next(line for line in text.splitlines() if "| in-painted photo |" in line)
    assert "18.00" in photo and "50.00" not in photo  # it says nothing of what arrived
    assert "LPIPS-out" not in text
    for name in ("paper_sheet.png", "paper_convergence_mine.png"):
        assert f"images/{name}" in text and (docs.parent / "images" / name).stat().st_size > 2000
    assert script.main() == 0
    assert docs.read_text() == text and text.startswith("# Results\n\nOther figures.\n")


def test_a_folder_without_its_parts_is_refused(
    tables: Callable[[str], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tables("paper_tables")
    monkeypatch.setattr(sys, "argv", ["paper_tables.py", "--folders", str(tmp_path), "--out", str(tmp_path / "out")])
    assert script.main() == 2
    assert f"{tmp_path / 'work'}: there is no such folder; give a folder with" in capsys.readouterr().err


def test_a_watched_update_is_the_same_update(
    tables: Callable[[str], Any], capture: Any, change: Any, old: Any, tmp_path: Path
) -> None:
    watched = tables("tables.watched")
    unlit, few = RelightConfig(still=False, moved=False), HelperConfig(steps=10, check_every=5, samples=1024)
    config = UpdateConfig(relight=unlit, fit=few)
    seen: list[int] = []

    def score(field: Any) -> dict[str, float | None]:
        seen.append(1)
        return {"psnr": float(field.density(torch.zeros(1, 3)))}

    usual = watched.train.HelperTraining
    found = watched.updated(capture, old, change, config, score)
    assert watched.train.HelperTraining is usual
    assert [p.step for p in found.curve] == [5, 10, 10] and len(seen) == 3
    assert found.curve[0].seconds < found.curve[-1].seconds == pytest.approx(sum(found.seconds.values()), abs=0.05)
    assert set(found.seconds) >= {"move", "supervise", "freeze", "train", "show"}
    again = update_field(capture, old, change, config)
    assert torch.equal(again.helper.encoding.tables, found.field.helper.encoding.tables)


def test_shown_from_another_height(tables: Callable[[str], Any], tmp_path: Path) -> None:
    """Views for Table 8 look at the same place from where they are said to stand."""
    from refield.synthetic.cameras import ring

    target = (0.1, -0.2, 0.3)
    for elevation in (15.0, 64.0):
        for pose in ring(target, 4, elevation, turn=45):
            toward = torch.tensor(target, dtype=torch.float64) - pose[:3, 3]
            assert torch.allclose(pose[:3, 2], toward / toward.norm(), atol=1e-9)
            up = float(torch.rad2deg(torch.asin(-toward[2] / toward.norm())))
            assert up == pytest.approx(elevation, abs=1e-6)


def test_each_departure_is_switched_off_by_itself(tables: Callable[[str], Any]) -> None:
    """And all of them together; where to look for what a switch does, each row's name says."""
    script = tables("departures")

    def choices(config: UpdateConfig) -> set[tuple[str, str, Any]]:
        stages = {k: v for k, v in asdict(config).items() if isinstance(v, dict) and k != "paper"}
        return {(stage, name, value) for stage, own in stages.items() for name, value in own.items()}

    usual, together = choices(script.DEFAULT), choices(script.OFF["all of these"])
    singles = {name: choices(config) - usual for name, config in script.OFF.items() if name != "all of these"}
    for row, found in singles.items():
        ((stage, name, _),) = found
        assert row.startswith(f"{stage}.{name.replace('_', '-')}")
    assert set.union(*singles.values()) == together - usual
