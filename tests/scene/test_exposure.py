"""How a camera took the light, and the file that keeps what a fit found out about photos."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from refield.scene.camera import Camera
from refield.scene.capture import Capture
from refield.scene.errors import InputError
from refield.scene.exposure import Exposure
from refield.scene.images import frame_image
from refield.scene.refined import in_words, refined, write_refined
from tests.captures import CAMERA, write_capture

DARKENED = Exposure((0.8, 1.0, 1.25), (-0.3, 0.05, -0.1))


def test_the_corners_show_the_vignetting_and_the_middle_the_gains() -> None:
    camera = Camera(33, 21, 30.0, 30.0, 16.5, 10.5)
    factor = DARKENED.factor(camera)
    torch.testing.assert_close(factor[10, 16], torch.tensor(DARKENED.gains))
    corner = torch.tensor(DARKENED.gains) * torch.tensor(-0.35).exp()
    assert ((factor[0, 0] - corner).abs() < 0.05).all() and (factor[0, 0] > corner).all()  # a pixel's centre is inside


def test_neutral_undoes_taken() -> None:
    scene = torch.rand(CAMERA.height, CAMERA.width, 3, generator=torch.Generator().manual_seed(0)) * 0.7
    photo = (DARKENED.taken(scene, CAMERA) * 255).round().to(torch.uint8)
    assert (DARKENED.neutral(photo, CAMERA).float() / 255 - scene).abs().max() < 0.006
    assert Exposure().neutral(photo, CAMERA).equal(photo)


def test_what_is_burnt_out_stays_so() -> None:
    white = torch.full((CAMERA.height, CAMERA.width, 3), 255, dtype=torch.uint8)
    assert Exposure((2.0, 2.0, 2.0)).neutral(white, CAMERA).equal(white)
    assert Exposure((2.0, 2.0, 2.0)).taken(torch.full((24, 32, 3), 0.6), CAMERA).max() == 1


def test_one_after_another_is_both() -> None:
    both = DARKENED.on(Exposure((0.5, 1.0, 2.0), (0.1, 0.0, 0.2)))
    torch.testing.assert_close(torch.tensor(both.gains), torch.tensor([0.4, 1.0, 2.5]))
    torch.testing.assert_close(torch.tensor(both.vignetting), torch.tensor([-0.2, 0.05, 0.1]))
    assert DARKENED.on(None) == DARKENED
    assert Exposure().stops == 0 and Exposure((2.0,) * 3).stops > 1 > 0 > Exposure((0.5,) * 3).stops


@pytest.fixture
def given(tmp_path: Path) -> Capture:
    return write_capture(tmp_path / "data", 4)


def found_of(given: Capture) -> Capture:
    """One photo moved, one of another lens and exposure, the others as they were."""
    a, b, *rest = given.frames
    pose = a.world_from_cam.clone()
    pose[0, 3] += 1 / 3
    lens = replace(b.camera, fx=41.5)
    return replace(given, frames=(replace(a, world_from_cam=pose), replace(b, camera=lens, exposure=DARKENED), *rest))


def test_what_was_found_survives_its_file(given: Capture, tmp_path: Path) -> None:
    found = found_of(given)
    write_refined(tmp_path / "refined.json", given, found)
    assert set(json.loads((tmp_path / "refined.json").read_text())["frames"]) == {f.name for f in found.frames[:2]}
    again = refined(given, tmp_path / "refined.json")
    for a, b in zip(again.frames, found.frames):
        assert torch.equal(a.world_from_cam, b.world_from_cam) and (a.camera, a.exposure) == (b.camera, b.exposure)
    photo = given.frames[1]
    assert torch.equal(frame_image(again.frames[1]), DARKENED.neutral(frame_image(photo), photo.camera))


def test_nothing_found_leaves_no_file(given: Capture, tmp_path: Path) -> None:
    write_refined(tmp_path / "refined.json", given, given)
    assert not (tmp_path / "refined.json").exists()
    assert refined(given, tmp_path / "refined.json") is given


def test_one_line_says_what_was_found(given: Capture) -> None:
    assert in_words(given, given) == ""
    said = in_words(given, found_of(given))
    exposures, poses, lenses = said.split("; ")
    assert exposures == "exposures differ by up to 0.0 stops"  # one alone is known, and its gains cancel out
    assert poses.startswith("poses moved by ") and 1 < float(poses.split()[3]) < 3
    assert lenses == "focal lengths changed by up to 3.8 %"
    lit = [replace(f, exposure=Exposure((g, g, g))) for f, g in zip(given.frames, (1.0, 0.5, 1.2, 1.0))]
    assert in_words(given, replace(given, frames=tuple(lit))) == "exposures differ by up to 2.8 stops"


def broken(entry: dict[str, Any]) -> list[Any]:
    camera, exposure = entry["camera"], entry["exposure"]
    return [
        [],
        {**entry, "world_from_cam": [[1.0, 2.0]]},
        {**entry, "camera": {**camera, "width": 7}},
        {**entry, "camera": {**camera, "lens": 1}},
        {**entry, "camera": {**camera, "fx": "long"}},
        {**entry, "camera": {**camera, "fx": 10**400}},
        {**entry, "camera": {**camera, "cx": float("nan")}},
        {**entry, "camera": "wide"},
        {**entry, "world_from_cam": [[float("inf")] * 4] * 4},
        {**entry, "exposure": {**exposure, "gains": [1, 1]}},
        {**entry, "exposure": {**exposure, "gains": [1, 0, 1]}},
        {**entry, "exposure": {**exposure, "vignetting": [1, float("nan"), 1]}},
        {**entry, "exposure": {"gains": [1, 1, 1]}},
    ]


def test_a_damaged_file_is_refused(given: Capture, tmp_path: Path) -> None:
    path = tmp_path / "refined.json"
    write_refined(path, given, found_of(given))
    name = given.frames[1].name
    sound = json.loads(path.read_text())["frames"][name]
    for entry in broken(sound):
        path.write_text(json.dumps({"frames": {name: entry}}))
        with pytest.raises(InputError, match=r"does not describe the photos|is not valid JSON"):
            refined(given, path)
    path.write_text(json.dumps({"frames": {"another.png": sound}}))
    with pytest.raises(InputError, match="another"):
        refined(given, path)
    path.write_text('{"frames": 3}')
    with pytest.raises(InputError, match="holds no frames"):
        refined(given, path)
    path.write_text("{")
    with pytest.raises(InputError):
        refined(given, path)
