"""The manual's pictures: what each stage of ``refield demo`` saw and found, one row of pictures for each.

    python benchmarks/stages.py WORK [--out docs/images/stages]

WORK is what ``refield demo WORK`` made. Its visit is estimated once more while the stages' own results are kept, so
that nothing is drawn but what they hand on. ``report.webp`` is left as it is where there is no Chromium (or no
playwright).
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from chromium import CHROMIUM
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter, ImageFont
from torch import Tensor

from refield.estimate import fit, recipe
from refield.estimate.detect import Changed
from refield.estimate.hull import Hull
from refield.estimate.pose_change import PoseChange
from refield.estimate.register import Candidate
from refield.field.radiance import Field
from refield.field.render import render_frame
from refield.history import state
from refield.report.pictures import IN_COLOUR, OUT_COLOUR
from refield.scene.capture import Capture, Frame
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.files import write_bytes
from refield.scene.images import frame_image
from refield.scene.load import load_capture, load_new_photos
from refield.synthetic import sample_folder
from refield.update.supervision import silhouette
from refield.workspace import Workspace

SIDE, GAP, CAPTION = 216, 6, 22
INK, PAPER, START = (60, 60, 67), (255, 255, 255), (234, 179, 8)
MOST = 150_000  # bytes of a picture

Tile = tuple[str, Image.Image]


@dataclass(frozen=True)
class Stages:
    """What the stages of one estimate handed on, and the fields before and after."""

    capture: Capture
    frames: list[Frame]
    before: Field
    after: Field
    change: SceneChange
    changed: Sequence[Changed]
    carved: list[Hull]
    """place by place"""
    candidates: Sequence[Candidate]
    refined: PoseChange


@contextmanager
def kept(module: Any, name: str, into: list[Any]) -> Iterator[None]:
    """What a function of a module gives, while it is at work."""
    function: Callable[..., Any] = getattr(module, name)

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        into.append(function(*args, **kwargs))
        return into[-1]

    with patch.object(module, name, wrapped):
        yield


def look(work: Path) -> Stages:
    """Estimate a demo's visit once more."""
    workspace = Workspace.open(work)
    capture, before = workspace.capture(), state(workspace, 0)
    frames = load_new_photos(workspace.visit(1) / "photos", capture)
    results: dict[str, list[Any]] = {name: [] for name in ("set_light_aside", "_carved", "register", "refine")}
    homes = (recipe.light, recipe, fit, fit)
    with ExitStack() as stack:
        for module, (name, into) in zip(homes, results.items()):
            stack.enter_context(kept(module, name, into))
        change = recipe.estimate_change(capture, before, frames)
    found = {name: into[-1] for name, into in results.items()}
    after = state(workspace, 1)
    return Stages(capture, frames, before, after, change, *found.values())


# --- pictures ---


def photo(image: Tensor | NDArray[Any]) -> Image.Image:
    """A picture (H, W, 3), uint8 or float in [0, 1], in the size of a tile."""
    pixels = torch.as_tensor(image)
    if pixels.is_floating_point():
        pixels = (pixels.clamp(0, 1) * 255).round().to(torch.uint8)
    return Image.fromarray(pixels.numpy()).resize((SIDE, SIDE), Image.Resampling.BICUBIC)


def marked(under: Image.Image, mask: Tensor | NDArray[Any], colour: tuple[int, ...], fill: float = 0.45) -> Image.Image:
    """What a mask (H, W) holds in a colour, its outline opaque."""
    area = Image.fromarray(np.asarray(mask, np.uint8) * 255).resize((SIDE, SIDE), Image.Resampling.BILINEAR)
    area = area.point(lambda v: 255 if v > 127 else 0)
    edge = np.asarray(area.filter(ImageFilter.MaxFilter(3))) & ~np.asarray(area.filter(ImageFilter.MinFilter(3)))
    alpha = np.maximum(np.asarray(area) * fill, edge).astype(np.uint8)
    return Image.composite(Image.new("RGB", under.size, colour), under, Image.fromarray(alpha))


def heat(values: NDArray[Any], most: float) -> Image.Image:
    """Values (H, W) from white (0) over orange to dark red (``most``)."""
    t = np.clip(values / most, 0, 1)[..., None]
    stops = np.array([(255, 255, 255), OUT_COLOUR, (127, 29, 29)], float)
    low, high = np.where(t < 0.5, stops[0], stops[1]), np.where(t < 0.5, stops[1], stops[2])
    return photo(np.round(low + (high - low) * (2 * t - (t >= 0.5))).astype(np.uint8))


def voxels(seen: Changed, centres: NDArray[Any], colour: tuple[int, ...]) -> Image.Image:
    """Voxels' centres (N, 3) as squares over a pale photo, the nearer over the further and the brighter."""
    h, w = seen.view.shape
    uv, distance, inside = seen.view.project(centres)
    order = np.argsort(-distance[inside])
    at, far = (uv[inside] * [SIDE / w, SIDE / h])[order], distance[inside][order]
    shades = 1.15 - 0.65 * (far - far[-1]) / max(float(far[0] - far[-1]), 1e-6)
    out = photo(0.35 * seen.view.photo + 0.65)
    draw = ImageDraw.Draw(out)
    for (u, v), shade in zip(at, shades):
        draw.rectangle((u - 1.2, v - 1.2, u + 1.2, v + 1.2), fill=tuple(min(int(c * shade), 255) for c in colour))
    return out


def row(tiles: Sequence[Tile]) -> Image.Image:
    """Pictures side by side under their captions."""
    sheet = Image.new("RGB", (len(tiles) * (SIDE + GAP) - GAP, SIDE + CAPTION), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for i, (said, picture) in enumerate(tiles):
        assert font.getlength(said) <= SIDE, said
        draw.text((i * (SIDE + GAP) + 1, 3), said, fill=INK, font=font)
        sheet.paste(picture, (i * (SIDE + GAP), CAPTION))
    return sheet


# --- stages ---


def fitted(s: Stages) -> list[Tile]:
    (frame, *_) = s.capture.held_out
    taken, shown = frame_image(frame), render_frame(s.before, frame).rgb
    off = (shown.clamp(0, 1) - taken.float() / 255 if not taken.is_floating_point() else shown - taken).abs().mean(-1)
    return [
        ("a photo that took no part", photo(taken)),
        ("the field, from there", photo(shown)),
        ("their difference", heat(off.numpy(), 0.3)),
    ]


def detected(s: Stages) -> list[Tile]:
    seen = s.changed[0]
    return [
        ("a new photo", photo(seen.view.photo)),
        ("the old field, from there", photo(seen.view.rgb)),
        ("difference over what is usual", heat(seen.difference / seen.threshold, 4.0)),
        ("changed", marked(photo(seen.view.photo), seen.mask, (147, 51, 234))),
    ]


def carved(s: Stages) -> list[Tile]:
    held = [(h.lattice.centres, h.hull & h.free, h.solid) for h in s.carved]
    was = np.concatenate([at[inside & solid] for at, inside, solid in held])
    now = np.concatenate([at[inside & ~solid] for at, inside, solid in held])
    first, other = s.changed[0], s.changed[2]
    return [
        ("where something was", voxels(first, was, OUT_COLOUR)),
        ("where something may be now", voxels(first, now, IN_COLOUR)),
        ("the same, from the third photo", voxels(other, now, IN_COLOUR)),
    ]


def moved(s: Stages) -> ObjectChange:
    """The demo's one object, which moved."""
    (thing,) = s.change.objects
    assert thing.new_from_old is not None
    return thing


def posed(s: Stages) -> list[Tile]:
    thing, frame = moved(s), s.changed[0].view.frame
    taken = photo(frame_image(frame))
    tried = taken
    for candidate in reversed(s.candidates):
        tried = marked(tried, silhouette((thing.grid.moved(candidate.new_from_old),), frame), START, 0.0)
    return [
        ("where it was", marked(taken, silhouette((thing.grid,), frame), OUT_COLOUR, 0.2)),
        (f"the {len(s.candidates)} best of the poses tried", tried),
        (
            "refined through the field",
            marked(taken, silhouette((thing.grid.moved(s.refined.new_from_old),), frame), IN_COLOUR, 0.2),
        ),
    ]


def segmented(s: Stages) -> list[Tile]:
    thing = moved(s)
    views = [(f, m) for f, m in zip(s.capture.train, thing.masks) if m is not None]
    chosen = views[:: max(1, len(views) // 3)][:3]
    return [
        (f"where it was, in old photo {i + 1}", marked(photo(frame_image(f)), mask, OUT_COLOUR))
        for i, (f, mask) in enumerate(chosen)
    ]


def updated(s: Stages) -> list[Tile]:
    frame = load_capture(sample_folder() / "eval").frames[0]
    return [
        ("before", photo(render_frame(s.before, frame).rgb)),
        ("after", photo(render_frame(s.after, frame).rgb)),
        ("a photo that took no part", photo(frame_image(frame))),
    ]


def report(page: Path) -> Image.Image | None:
    """The upper part of a report's page; None where there is no browser."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    if CHROMIUM is None:
        return None
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        view = browser.new_page(viewport={"width": 900, "height": 1150})
        view.goto(page.resolve().as_uri())
        shot = view.screenshot()
        browser.close()
    return Image.open(io.BytesIO(shot)).convert("RGB")


def save(picture: Image.Image, path: Path) -> None:
    """As WebP, as well as fits."""
    for quality in (90, 80, 70, 60):
        buffer = io.BytesIO()
        picture.save(buffer, "WEBP", quality=quality, method=6)
        if buffer.tell() < MOST:
            break
    write_bytes(path, buffer.getvalue())
    print(f"{path}: {picture.width} x {picture.height}, {buffer.tell() / 1e3:.0f} kB")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, metavar="WORK")
    parser.add_argument("--out", type=Path, default=Path("docs/images/stages"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    stages = look(options.work)
    for drawn in (fitted, detected, carved, segmented, posed, updated):
        save(row(drawn(stages)), options.out / f"{drawn.__name__}.webp")
    page = report(Workspace.open(options.work).visit(1) / "report.html")
    if page is None:
        print("no Chromium, or no playwright: report.webp is left as it is", file=sys.stderr)
    else:
        save(page, options.out / "report.webp")
    return 0


if __name__ == "__main__":
    sys.exit(main())
