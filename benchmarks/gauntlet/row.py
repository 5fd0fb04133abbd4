"""One scene from its photos to its row, and a strip of pictures of it."""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import torch
from change_score import pooled_iou
from PIL import Image
from tables.tiles import GAP, SIDE, masks_of, tile, write_picture

from gauntlet.chain import Chain, Ran, failure
from gauntlet.match import Row, pose_row, true_objects
from gauntlet.trials import Trial, make
from refield.rehearse.matching import matched
from refield.scene.capture import Frame, centres
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.change_files import NAME, load_change
from refield.scene.files import read_json, write_json
from refield.scene.images import frame_image, read_image
from refield.scene.load import is_posed
from refield.scene.transforms_json import load_transforms, stem

RESULT, STRIP, SCORES = "row.json", "strip.png", "scores.json"
_ROUND, _PLAIN = ("ball", "can", "pole", "cone"), "plain"
BRIGHTER = 3
"""the factor by which errors are shown"""
_SCORED = ("psnr", "psnr_in", "psnr_out", "psnr_untouched")


def run_trial(trial: Trial, folder: Path) -> Row:
    """All commands of a scene in ``folder``, its row and its strip."""
    chain = Chain(folder)
    data = make(trial, chain)
    if data is not None:
        run_commands(chain, data, trial.train)
    row = scored(folder, data, chain.ran)
    if data is not None:
        _strip(folder, data)
    return row


def run_commands(chain: Chain, data: Path, train: Sequence[str] = ()) -> None:
    """Train, update, render both states, evaluate; after an update that failed the others show the old field."""
    work, evaluation = chain.folder / "work", data / "eval"
    if not chain.run("train", "train", data / "before", work, *train):
        return
    chain.run("update", "update", work, data / "after")
    if is_posed(evaluation):
        render = ("render", work, "--cameras", evaluation / "transforms.json", "--out")
        chain.run("render", *render, chain.folder / "renders")
        chain.run("render before", *render, chain.folder / "renders_before", "--visit", "0")
    chain.run("evaluate", "evaluate", work, evaluation, "--out", chain.folder / SCORES)


def forget(folder: Path) -> None:
    """Remove what is large; the row, the strip, the logs and what the visit's report says stay."""
    report = folder / "work" / "visits" / "001" / "report.json"
    if report.is_file():
        report.rename(folder / report.name)
    for part in ("data", "base", "work", "renders", "renders_before"):
        shutil.rmtree(folder / part, ignore_errors=True)


def scored(folder: Path, data: Path | None, ran: Sequence[Ran]) -> Row:
    """What a scene's folder tells, as far as its commands came."""
    row: Row = {"failed": failure(ran), "seconds": {r["name"]: r["seconds"] for r in ran if "seconds" in r}}
    if data is None:
        return row
    facts = data / "truth" / "world.json"
    row["facts"] = read_json(facts) if facts.is_file() else {}
    field = folder / "work" / "field" / "field.json"
    row["held-out"] = read_json(field).get("held_out_psnr") if field.is_file() else None
    visit = folder / "work" / "visits" / "001"
    change = load_change(visit) if (visit / NAME).is_file() else None
    true = true_objects(data)
    if true is not None:
        row |= _objects(change, true, row["facts"])
    if change is not None:
        row["not understood"] = bool(change.unexplained)
        row["new photos used"] = f"{len(change.frames)} of {len(change.photos)}"
        row |= _masks(change, data / "after")
    scores = folder / SCORES
    return row | (_scores(read_json(scores)) if scores.is_file() else {})


def _objects(change: SceneChange | None, true: Sequence[ObjectChange], facts: Row) -> Row:
    """Kinds told and true, and each true object with what was found of it."""
    found = () if change is None else change.objects
    match = matched(found, true)
    objects, unseen = [], symmetric(facts, len(true))
    for k, t in enumerate(true):
        f = found[match.pairs[k]] if k in match.pairs else None
        one: Row = {"true": t.kind, "told": None if f is None else f.kind, "symmetric": k in unseen}
        if f is not None and change is not None:
            one |= {"confidence": float(f.confidence)} | pose_row(f, t, centres(change.frames))
        if one["symmetric"]:
            one.pop("off, °", None)
        objects.append(one)
    right = all(o["told"] == o["true"] for o in objects) and len(found) == len(true) and change is not None
    return {
        "true": sorted(t.kind for t in true),
        "told": None if change is None else sorted(f.kind for f in found),
        "same kinds": change is not None and Counter(t.kind for t in true) == Counter(f.kind for f in found),
        "objects": objects,
        "false": len(match.false),
        "pieces": len(match.pieces),
        "missed": match.missed(len(true)),
        "right": right and not (change is not None and change.unexplained),
    }


def facts_of(facts: Row, count: int) -> list[Row]:
    """What the facts tell of each of the ``count`` true objects, in their order; nothing where that is not known.

    They tell of each thing in the scene; true objects that were there come first, then what arrived.
    """
    changed = [o for o in facts.get("objects", []) if o["change"] != "none"]
    changed.sort(key=lambda o: o["change"] == "added")
    return changed if len(changed) == count else []


def symmetric(facts: Row, count: int) -> set[int]:
    """Indices of the ``count`` true objects whose turn cannot be seen: round ones of one colour."""
    changed = facts_of(facts, count)
    return {i for i, o in enumerate(changed) if o["family"] in _ROUND and o["texture"] == _PLAIN}


def _masks(change: SceneChange, after: Path) -> Row:
    """IoU of the new photos' masks with the true ones, pooled over the photos."""
    out: Row = {}
    for kind, found in (("in", change.masks_in), ("out", change.masks_out)):
        true = [masks_of(after, frame.name).get(kind) for frame in change.frames]
        pairs = [(a, b) for a, b in zip(found, true) if b is not None and a.shape == b.shape]
        out[f"mask-{kind}"] = pooled_iou(*zip(*pairs)) if pairs else None
    return out


def _scores(told: Row) -> Row:
    now, before = told["pooled"], told["pooled_before"] or told["pooled"]
    return {k: now[k] for k in _SCORED} | {f"{k} before": before[k] for k in _SCORED}


# --- pictures ---


def _strip(folder: Path, data: Path) -> None:
    """Old render · photo · render now · absolute error, of the view that shows most of what changed."""
    if not is_posed(data / "eval"):
        return
    frames = load_transforms(data / "eval").frames
    frame = max(frames, key=lambda f: _changed(data / "eval", f))
    renders = [folder / name / f"{stem(frame)}.png" for name in ("renders_before", "renders")]
    masks, photo = masks_of(data / "eval", frame.name), frame_image(frame).float() / 255
    old, now = (read_image(p).float() / 255 if p.is_file() else None for p in renders)
    error = None if now is None else BRIGHTER * (now - photo).abs()
    out = Image.new("RGB", (4 * (SIDE + GAP), SIDE), "white")
    for i, picture in enumerate((old, photo, now, error)):
        if picture is not None:
            out.paste(tile(picture, masks), (i * (SIDE + GAP), 0))
    write_picture(folder / STRIP, out)


def _changed(evaluation: Path, frame: Frame) -> int:
    """Pixels, of the smaller one of the masks that are not empty."""
    return min((n for m in masks_of(evaluation, frame.name).values() if (n := int(m.sum()))), default=0)


def keep(folder: Path, row: Row) -> None:
    """The row on disk, which marks the scene as finished."""
    write_json(folder / RESULT, _plain(row))


def _plain(value: object) -> object:
    """As JSON can hold it: what is no number is None."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, torch.Tensor):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
