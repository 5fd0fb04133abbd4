"""The packaged sample is whole, small and true."""

import pytest
import torch

from refield.scene.change_files import load_change
from refield.scene.images import frame_image, read_mask
from refield.scene.pose import invert, transform
from refield.scene.transforms_json import load_transforms
from refield.synthetic import sample_folder
from refield.synthetic.worlds import WORLDS


@pytest.fixture(scope="module")
def parts():
    return {part: load_transforms(sample_folder() / part) for part in ("before", "after", "eval")}


def test_it_is_small():
    assert sum(f.stat().st_size for f in sample_folder().rglob("*") if f.is_file()) <= 6_000_000


def test_it_is_complete(parts):
    assert {k: len(v.frames) for k, v in parts.items()} == {"before": 70, "after": 4, "eval": 4}
    for capture in parts.values():
        for frame in capture.frames:
            assert 128 <= frame.camera.width <= 160
            image = frame_image(frame).float() / 255
            assert 0.15 < image.mean() < 0.75 and image.std() > 0.08
            assert (image > 0.999).float().mean() < 0.05  # not over-exposed


def test_its_truth_is_the_world_it_was_made_from(parts):
    change = load_change(sample_folder() / "truth", parts["before"], photos=parts["after"].frames)
    (found,), (true,) = change.objects, WORLDS["table"](0).changes
    assert found.kind == "moved"
    assert torch.allclose(found.new_from_old, true.new_from_old, atol=1e-12)
    assert len(found.masks) == len(parts["before"].train)


def test_its_masks_are_where_the_grid_projects(parts):
    change = load_change(sample_folder() / "truth", parts["before"], photos=parts["after"].frames)
    old = change.objects[0].grid.occupied().double()
    for kind, points in (("masks_out", old), ("masks_in", transform(change.objects[0].new_from_old, old))):
        for part in ("after", "eval"):
            for frame in parts[part].frames:
                mask = read_mask(sample_folder() / part / kind / frame.path.name)
                px, _ = frame.camera.project(transform(invert(frame.world_from_cam), points))
                column, row = px.long().unbind(-1)
                splat = torch.zeros_like(mask)
                splat[row, column] = True
                assert (splat & mask).sum() / mask.sum() > 0.97  # others may stand before it
