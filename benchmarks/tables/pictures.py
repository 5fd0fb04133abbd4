"""Figs. 8, 15, 17 and 18: the sheet of renders, and curves."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from refield.scene.files import write_bytes
from refield.scene.images import frame_image, read_image
from refield.scene.transforms_json import load_transforms
from tables.cases import Case
from tables.kept import Kept
from tables.methods import VIEWS
from tables.show import Found
from tables.tiles import CAPTION, GAP, SIDE, masks_of, tile, write_picture

COLUMNS = {
    "old": "before",
    "truth": "truth",
    "ours": "ours",
    "retrained": "re-trained",
    "finetuned": "fine-tuned",
    "inpainted": "in-painted",
    "lama_photo": "LaMa",
}
_INKS = {"ours": "#0f766e", "retrained": "#b45309", "retrained_long": "#d97706", "finetuned": "#7c3aed"}
_SECONDS = [t * 10**k for k in range(5) for t in (1, 2, 5)]  # where a logarithmic axis is labelled
_LABELS = {"retrained_long": "re-trained for longer"}


def sheet(kept: Kept, cases: Sequence[Case], path: Path) -> bool:
    """New photo · before · truth · ours · baselines, a row for each case; whether there was anything to draw."""
    rows = [row for c in cases if (row := _row(kept, c)) is not None]
    if not rows:
        return False
    columns = [c for c in ("new photo", *COLUMNS.values()) if any(c in row for row in rows)]
    height = CAPTION + len(rows) * (SIDE + GAP)
    out = Image.new("RGB", (len(columns) * (SIDE + GAP) + GAP, height), "white")
    draw, font = ImageDraw.Draw(out), ImageFont.load_default(13)
    for i, column in enumerate(columns):
        x = GAP + i * (SIDE + GAP)
        draw.text((x, CAPTION / 2), column, fill=(60, 60, 67), font=font, anchor="lm")
        for j, row in enumerate(rows):
            if column in row:
                out.paste(row[column], (x, CAPTION + j * (SIDE + GAP)))
    write_picture(path, out)
    return True


def _row(kept: Kept, case: Case) -> dict[str, Image.Image] | None:
    if kept.get(case.key, "ours") is None:
        return None
    frames = load_transforms(case.evaluation).frames
    masks = {i: masks_of(case.evaluation, f.path.name) for i, f in enumerate(frames)}
    best = max(masks, key=lambda i: min((int(m.sum()) for m in masks[i].values()), default=0))
    row = {"new photo": tile(frame_image(case.frames[0]).float() / 255, {})}
    for method, title in COLUMNS.items():
        source = kept.pictures(case.key, method) / f"{best:04d}.png"
        if method == "truth":
            row[title] = tile(frame_image(frames[best]).float() / 255, masks[best])
        elif source.is_file():
            row[title] = tile(read_image(source).float() / 255, masks[best])
    return row


# --- curves ---


def convergence(found: Found, world: str, path: Path) -> bool:
    """Fig. 15: whole-view SSIM and PSNR, PSNR-out and PSNR-in over seconds of training."""
    panels = {"ssim": "SSIM, whole views", "psnr": "PSNR, whole views, dB", "psnr_out": "PSNR-out, dB"}
    panels["psnr_in"] = "PSNR-in, dB"
    runs = [(m, r["curve"]) for m in _INKS for r in found.of(world, m) if len(r.get("curve", [])) > 1]
    if not runs:
        return False
    figure, axes = _figure(len(panels))
    for axis, (name, title) in zip(axes, panels.items()):
        for method, curve in runs:
            known = [(p["seconds"], p["scores"][name]) for p in curve if p["scores"].get(name) is not None]
            if known:
                axis.plot(*zip(*known), color=_INKS[method], marker=".", lw=1.2)
        axis.set(xscale="log", xlabel="seconds of training", title=title)
        shown = [t for t in _SECONDS if axis.get_xlim()[0] <= t <= axis.get_xlim()[1]]
        axis.set_xticks(shown, [str(t) for t in shown])
        axis.set_xticks([], minor=True)
        axis.grid(alpha=0.25, lw=0.5)
    for method in dict.fromkeys(m for m, _ in runs):
        axes[0].plot([], [], color=_INKS[method], label=_LABELS.get(method) or COLUMNS[method])
    axes[0].legend(frameon=False, loc="lower right", fontsize=8)
    _save(figure, path)
    return True


def number_of_views(found: Found, path: Path) -> bool:
    """Figs. 17 and 18: quality where something left, over the number of new photos."""
    panels = {"psnr_out": "PSNR-out, dB", "ssim_out": "SSIM-out", "lpips_out": "LPIPS-out"}
    points: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for world in found.worlds():
        for name in panels:
            for count in VIEWS:
                each = [r["scores"]["as rendered"].get(name) for r in found.of(world, f"true_{count}_views")]
                known = [v for v in each if v is not None]
                if known:
                    points.setdefault((name, world), []).append((count, sum(known) / len(known)))
    shown = [n for n in panels if any(key[0] == n for key in points)]
    if not shown:
        return False
    figure, axes = _figure(len(shown))
    for axis, name in zip(axes, shown):
        for (measure, world), line in points.items():
            if measure == name:
                axis.plot(*zip(*line), marker="o", ms=3, lw=1.2, label=world)
        axis.set(xlabel="new photos", title=panels[name], xticks=VIEWS)
        axis.grid(alpha=0.25, lw=0.5)
    axes[0].legend(frameon=False)
    _save(figure, path)
    return True


def _figure(panels: int) -> tuple[Any, Any]:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, panels, figsize=(3.6 * panels, 3.0), layout="constrained", squeeze=False)
    return figure, axes[0]


def _save(figure: Any, path: Path) -> None:
    from matplotlib import pyplot

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    pyplot.close(figure)
    write_bytes(path, buffer.getvalue())
