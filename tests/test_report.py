"""The report page: self-contained, escaped, true to what it is given."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from refield.commands.visits import _told as visits_told
from refield.report import (
    Comparison,
    VisitReport,
    summary,
    visit_report_dict,
    write_contact_sheet,
    write_report,
)
from refield.report.page import html_page
from refield.report.pictures import IN_COLOUR, OUT_COLOUR, data_uri, marks_uri
from refield.report.visit import object_shift, turn, uncertainty
from refield.scene import pose
from refield.scene.camera import Camera
from refield.scene.capture import Frame, camera_rays
from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, SceneChange
from tests.visit_pages import CAMERA, EVIL, visit_report

MOVE = pose.exp(torch.tensor([0.3, 0.0, 0.1, 0.0, 0.0, math.radians(30)], dtype=torch.float64))


def grid(centre: float = 0.0) -> OccupancyGrid:
    box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]]) + centre
    return OccupancyGrid(box, torch.ones(5, 5, 5))


def moved(**more: object) -> ObjectChange:
    return replace(ObjectChange("moved", grid(2.0), MOVE, confidence=0.9), **more)  # type: ignore[arg-type]


def photo(name: str, used: bool = True) -> PlacedPhoto:
    if not used:
        return PlacedPhoto(name, "rejected", "only 7 inliers")
    frame = Frame(Path(name), Camera(30, 20, 30, 30, 15, 10), name, torch.eye(4, dtype=torch.float64))
    return PlacedPhoto(name, "used", frame=frame)


def picture(seed: int) -> torch.Tensor:
    return torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(seed))


def view(name: str, **more: object) -> Comparison:
    return replace(Comparison(name, picture(0), picture(1), picture(2)), **more)  # type: ignore[arg-type]


class Reader(HTMLParser):
    """Collects what a browser would see, and checks that tags nest."""

    VOID = ("meta", "img", "input", "link", "br", "hr")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    @staticmethod
    def of(source: str) -> Reader:
        reader = Reader()
        reader.feed(source)
        assert not reader.open
        return reader

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("script", "style"):
            self.text.append(data)


def read(report: VisitReport, folder: Path) -> tuple[str, Reader]:
    source = write_report(folder, report).read_text(encoding="utf-8")
    return source, Reader.of(source)


def test_the_page_holds_everything_it_is_given(tmp_path: Path) -> None:
    _, reader = read(visit_report(), tmp_path / "visit")
    text = " ".join(" ".join(reader.text).split())
    for told in (
        "One object moved, one is gone, one is new", "7 March 2026, 09:05 UTC", "2 new photos", "Part of what changed",
        "because", "only 7 inliers", "30.00°", "27.12", "12.50", "0.912", "31.23", "1.2", "torch", "part of it",
        "Comparing the new photos with the model", "detect", "Making the model from 63 photos", "violet", "24.8",
    ):  # fmt: skip
        assert told in text, told
    pictures = [a["src"] for t, a in reader.tags if t == "img"]
    assert len(pictures) == 2 * (2 + 2) + 3  # before and after, the photo and its marks; the evaluation view has none


def test_nothing_is_fetched_and_nothing_runs_but_our_script(tmp_path: Path) -> None:
    source, reader = read(visit_report(), tmp_path)
    (script,) = re.findall(r"<script>(.*?)</script>", source, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in source and "default-src 'none'" in source
    for tag, attributes in reader.tags:
        for key, value in attributes.items():
            assert not key.startswith("on"), (tag, key)
            if key in ("src", "data", "action"):
                assert value is not None and value.startswith("data:image/"), (tag, value)
    links = [a["href"] for t, a in reader.tags if t == "a"]
    assert links == ["../001/report.html", "change.json", "report.json"]
    assert not re.search(r"(https?:)?//\w|@import|url\(", re.sub(r"base64,[\w+/=]+", "", source.replace(script, "")))
    assert not re.search(r"https?:|fetch|import|eval|innerHTML", script)


def test_text_from_outside_is_shown_not_obeyed(tmp_path: Path) -> None:
    source, reader = read(visit_report(), tmp_path)
    assert "alert" in source and "<script>alert" not in source
    assert any(EVIL in piece for piece in reader.text)


def test_the_pictures_are_the_pictures(tmp_path: Path) -> None:
    report = VisitReport("w", SceneChange(photos=(photo("a.png"),)), photos=(view("a.png"),))
    _, reader = read(report, tmp_path)
    sources = {a["alt"]: a["src"] or "" for t, a in reader.tags if t == "img"}
    decoded = Image.open(io.BytesIO(base64.b64decode(sources["Photo 1 (a.png): the photo"].split(",")[1])))
    assert (np.asarray(decoded) == (picture(0) * 255).round().to(torch.uint8).numpy()).all()


def pictures_of(reader: Reader) -> list[Image.Image]:
    uris = [a["src"] or "" for t, a in reader.tags if t == "img"]
    return [Image.open(io.BytesIO(base64.b64decode(u.split(",")[1]))) for u in uris]


def test_large_pictures_are_scaled_and_compressed() -> None:
    uri = data_uri(torch.rand(900, 1600, 3))
    decoded = Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1])))
    assert uri.startswith("data:image/jpeg") and decoded.size == (960, 540)


def test_a_page_has_a_bounded_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many photos there are: their pixels are shared out, and not all views of an evaluation are shown."""
    monkeypatch.setattr("refield.report.page.ALL_PIXELS", 20_000)
    monkeypatch.setattr("refield.report.page.MOST_VIEWS", 5)
    large = Comparison("x", *(torch.rand(100, 150, 3) for _ in range(3)), mask_in=torch.ones(100, 150) > 0)
    views = tuple(replace(large, name=f"{i}.png") for i in range(8))
    photos = tuple(photo(f"{i}.png") for i in range(8))
    _, reader = read(VisitReport("w", SceneChange(photos=photos), photos=views, evaluation_views=views), tmp_path)
    shown = pictures_of(reader)
    assert len(shown) == (8 + 5) * 4  # the marks lie over the photo with the same size
    assert sum(p.width * p.height for p in shown) * 3 / 4 == pytest.approx(20_000, rel=0.1)


def test_marks_are_drawn_in_their_colours_over_nothing() -> None:
    mask_in, mask_out = torch.zeros(2, 20, 30, dtype=torch.bool)
    mask_in[2:8, 2:8] = True
    mask_out[10:16, 20:26] = True
    uri = marks_uri(mask_in, mask_out)
    drawn = np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))).convert("RGBA"))
    assert drawn[2, 2].tolist() == [*IN_COLOUR, 255] and drawn[10, 20].tolist() == [*OUT_COLOUR, 255]
    assert drawn[5, 5, :3].tolist() == list(IN_COLOUR) and 80 < drawn[5, 5, 3] < 150
    assert drawn[18, 28, 3] == 0
    with pytest.raises(ValueError, match="no mask"):
        marks_uri(None, None)


def test_no_change_is_a_report_too(tmp_path: Path) -> None:
    change = SceneChange(photos=(photo("a.png"), photo("b.png")), why="The renders explain the photos.")
    source, reader = read(VisitReport("w, visit 1", change, photos=(view("a.png", after=None),)), tmp_path)
    text = "".join(reader.text)
    assert "Nothing changed" in text and "The renders explain the photos." in text
    assert [a["alt"] for t, a in Reader.of(source).tags if t == "img"] == [
        "Photo 1 (a.png): the model from here",
        "Photo 1 (a.png): the photo",
    ]
    assert "What changed" not in text and "moved" not in text.replace("no object moved", "")
    told = json.loads((tmp_path / "report.json").read_text())
    assert told["objects"] == [] and told["evaluation"] is None


def test_report_json_tells_the_same(tmp_path: Path) -> None:
    report = replace(visit_report(), facts={"psnr": math.nan})
    write_report(tmp_path, report)
    told = json.loads((tmp_path / "report.json").read_text())
    assert told == json.loads(json.dumps(visit_report_dict(report), allow_nan=False))
    assert told["facts"] == {"psnr": None}
    assert [o["kind"] for o in told["objects"]] == ["moved", "removed", "added"]
    assert told["objects"][0]["angle_deg"] == pytest.approx(30)
    assert told["made"] == "2026-03-07T09:05:00+00:00"
    assert told["objects"][1]["new_from_old"] is None
    assert told["photos"][2] == {"file": EVIL, "status": "rejected", "why": "only 7 inliers"}


@pytest.mark.parametrize(
    ("kinds", "used", "rejected", "sentence"),
    [
        ([], 1, 0, "Nothing changed; seen in 1 new photo."),
        (["moved"], 4, 0, "1 object changed: 1 moved; seen in 4 new photos."),
        (["added", "moved"], 2, 1, "2 objects changed: 1 moved, 1 added; seen in 2 new photos (1 rejected)."),
    ],
)  # fmt: skip
def test_summary(kinds: list[str], used: int, rejected: int, sentence: str) -> None:
    objects = tuple(moved() if k == "moved" else ObjectChange(k, grid()) for k in kinds)  # type: ignore[arg-type]
    photos = [photo(f"{i}") for i in range(used)] + [photo(f"r{i}", used=False) for i in range(rejected)]
    assert summary(SceneChange(objects, tuple(photos))) == sentence


def test_a_turn_has_its_angle_and_axis() -> None:
    angle, axis = turn(MOVE)
    assert angle == pytest.approx(30) and axis == pytest.approx([0, 0, 1])
    assert turn(torch.eye(4)) == (0.0, [0.0, 0.0, 0.0])


def test_an_objects_shift_does_not_depend_on_the_worlds_origin() -> None:
    far = torch.eye(4, dtype=torch.float64)
    far[:3, 3] = torch.tensor([100.0, -50.0, 7.0])
    there = ObjectChange("moved", grid(2.0), MOVE)
    box = there.grid.aabb + torch.tensor([100.0, -50.0, 7.0])
    elsewhere = ObjectChange("moved", OccupancyGrid(box, there.grid.values), far @ MOVE @ pose.invert(far))
    assert object_shift(there) == pytest.approx(object_shift(elsewhere), abs=1e-4)


def test_uncertainty_is_that_of_sampled_poses() -> None:
    g = torch.Generator().manual_seed(0)
    root = torch.randn(6, 6, generator=g, dtype=torch.float64) * 1e-3
    change = moved(covariance=root @ root.T)
    told, centre = uncertainty(change), torch.tensor([2.0, 2, 2], dtype=torch.float64)
    twists = torch.randn(20000, 6, generator=g, dtype=torch.float64) @ root.T
    # two opposite sides, each anywhere in one of the grid's cells, which are 0.5 wide
    centres = centre + ((torch.rand(20000, 2, 3, generator=g, dtype=torch.float64) - 0.5) * 0.5).mean(1)
    shifts = pose.transform(pose.exp(twists) @ MOVE, centres) - centres
    off = shifts - (pose.transform(MOVE, centre) - centre)
    assert told is not None
    assert told[0] == pytest.approx(float(off.square().sum(-1).mean().sqrt()), rel=0.03)
    angles = twists[:, 3:].square().sum(-1).mean().sqrt()
    assert told[1] == pytest.approx(math.degrees(float(angles)), rel=0.03)
    assert uncertainty(moved()) is None


def test_a_move_is_told_as_one_length(tmp_path: Path) -> None:
    """Of a thing that is larger on one side, and so has its middle elsewhere than its box."""
    values = torch.zeros(9, 9, 9)
    values[1:8, 1:8, 1:3] = 1
    values[1:3, 1:3, 1:8] = 1
    change = ObjectChange("moved", OccupancyGrid(grid(2.0).aabb, values), MOVE)
    assert float((change.centre - change.grid.tight_aabb().mean(0)).norm()) > 0.1
    assert change.shift is not None
    length = float(change.shift.norm())
    told = visit_report_dict(VisitReport("x", SceneChange((change,))))["objects"][0]
    assert math.hypot(*told["shift"]) == pytest.approx(length)
    assert math.hypot(*(object_shift(change) or ())) == pytest.approx(length)
    assert visits_told(change)["moved_by"] == pytest.approx(length)
    assert f"{length:.4g}" in html_page(VisitReport("x", SceneChange((change,))))


def test_the_contact_sheet_shows_whole_rows_only(tmp_path: Path) -> None:
    whole = Comparison("a", torch.zeros(20, 30, 3), torch.ones(20, 30, 3), torch.full((20, 30, 3), 0.5))
    path = write_contact_sheet(tmp_path / "sheet.png", [whole, view("b", after=None)], height=40)
    sheet = np.asarray(Image.open(path))
    assert sheet.shape == (22 + 48 + 8, 3 * 60 + 32, 3)
    row = sheet[22 + 24]
    assert [row[8 + 30 + k * 68].tolist()[0] for k in range(3)] == [255, 0, 128]
    with pytest.raises(ValueError, match="no view"):
        write_contact_sheet(tmp_path / "none.png", [view("b", before=None)])


def test_the_scene_in_3d_is_where_the_photos_show_it() -> None:
    report = visit_report()
    told = json.loads(unescape(re.findall(r'data-space="([^"]*)"', html_page(report))[0]))
    ways = [state["xyz"] for state in told["states"]]
    assert ways[0] == ways[1] != ""  # the views' depths are the same
    xyz = (np.frombuffer(base64.b64decode(ways[0]), "<u2").reshape(-1, 3) / 32767.5 - 1) * told["within"]
    (was, now), (left, none), (never, came) = told["objects"]
    assert none is None and never is None
    unit = 1 / np.linalg.norm(np.mean(now, 0) - np.mean(was, 0))  # it was moved by 1
    assert np.mean(was[4:], 0)[2] - np.mean(was[:4], 0)[2] == pytest.approx(0.75 / unit, rel=0.05)
    assert len(left) == len(came) == 8
    ends = 6 * camera_rays(CAMERA, torch.eye(4, dtype=torch.float64)).directions  # up is -y
    assert np.ptp(xyz[:, 2]) * unit == pytest.approx(float(ends[:, 1].max() - ends[:, 1].min()), rel=0.05)
    few = replace(report, photos=tuple(replace(p, depth_after=None) for p in report.photos))
    assert "data-space" not in html_page(few) and "data-space" not in html_page(VisitReport("x", SceneChange()))
