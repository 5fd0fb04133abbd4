"""The renderer and the closed forms see the same scene; a written world is complete."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from refield.field.render import render_camera
from refield.scene.change_files import load_change
from refield.scene.errors import InputError
from refield.scene.images import read_image, read_mask
from refield.scene.transforms_json import load_transforms
from refield.synthetic import pathtrace, random_write
from refield.synthetic.cameras import ring, square_camera
from refield.synthetic.oracles import AnalyticField
from refield.synthetic.visibility import view_hits
from refield.synthetic.worlds import WORLDS
from refield.synthetic.write import SynthConfig, write_world

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module")
def tracer():
    pytest.importorskip("mitsuba", reason="the renderer is an extra: pip install 'refield[synth]'")
    return pathtrace.PathTracer


def test_the_probe_names_a_variant_and_survives_a_broken_one(monkeypatch):
    assert pathtrace.variant() in ("llvm_ad_rgb", "scalar_rgb")
    for broken in ("import os; os.abort()", "print('none')", "print(15)"):
        monkeypatch.setattr(pathtrace, "_PROBE", broken)
        assert pathtrace.variant.__wrapped__() == "scalar_rgb"


def test_a_missing_renderer_is_one_clear_line(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    with pytest.raises(InputError, match=r"pip install 'refield\[synth\]'"):
        pathtrace.mitsuba.__wrapped__()


def test_a_missing_renderer_is_told_before_a_world_is_drawn(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    monkeypatch.setattr(random_write, "mitsuba", pathtrace.mitsuba.__wrapped__)
    monkeypatch.setattr(random_write, "random_world", None)
    with pytest.raises(InputError, match=r"pip install 'refield\[synth\]'"):
        random_write.write_random(tmp_path / "out", SynthConfig())
    assert not (tmp_path / "out").exists()


def evenly_lit(state):
    """The same solids, matt and under the same light from everywhere."""
    items = tuple(replace(item, glossy=False) for item in state.items)
    return replace(state, items=items, surroundings=np.ones((8, 16, 3), np.float32))


def grown(mask):
    return torch.nn.functional.max_pool2d(mask[None].float(), 3, 1, 1)[0] > 0


def test_the_picture_shows_each_item_where_the_closed_form_has_it(tracer):
    """One object painted red, one blue, on black: the colour names the item, but for pixels on an edge."""
    state = evenly_lit(WORLDS["removed"](0).before)
    paints = np.array([[0.02, 0.02, 0.02], [0.9, 0.02, 0.02], [0.02, 0.02, 0.9]], np.float32)
    painted = [replace(i, texture=np.broadcast_to(p, i.texture.shape).copy()) for i, p in zip(state.items, paints)]
    state = replace(state, items=tuple(painted))
    camera, pose = square_camera(48), ring((0, 0, 0.15))[1]
    image = tracer(state).photo(camera, pose, 32, 0)
    assert image.shape == (48, 48, 3) and image.isfinite().all()
    item = view_hits(state, camera, pose).item
    for index, channel in ((1, 0), (2, 2)):
        seen = image[..., channel] > image[..., 2 - channel] + 0.15
        there = item == index
        assert there.sum() > 100
        assert seen[~grown(~there)].all() and not (seen & ~grown(there)).any()


def test_the_texture_is_laid_on_as_the_closed_form_says(tracer):
    """Under even light the photo is the texture, but for some dark near the floor."""
    state = evenly_lit(WORLDS["cube"](0).before)
    camera, pose = square_camera(64), ring((0, 0, 0.15))[2]
    photo = tracer(state).photo(camera, pose, 32, 0)
    plain = render_camera(AnalyticField(state), camera, pose).rgb
    item = view_hits(state, camera, pose).item
    for index in (0, 1):
        inner = ~grown(item != index)
        for channel in range(3):
            pair = torch.stack([photo[inner][:, channel], plain[inner][:, channel]])
            assert torch.corrcoef(pair)[0, 1] > 0.85


def test_a_written_world_is_complete_and_consistent(tracer, tmp_path):
    seen = []
    write_world(
        "added",
        tmp_path,
        size=32,
        spp=4,
        cameras=10,
        seed=1,
        on_progress=lambda done, n: seen.append((done, n)),
    )
    assert seen == [(i + 1, 18) for i in range(18)]
    before, after, evaluation = (load_transforms(tmp_path / part) for part in ("before", "after", "eval"))
    assert (len(before.frames), len(after.frames), len(evaluation.frames)) == (10, 4, 4)
    change = load_change(tmp_path / "truth", before, photos=after.frames)
    assert [o.kind for o in change.objects] == ["added"] and len(change.frames) == 4
    for frame in after.frames + evaluation.frames:
        folder = frame.path.parent.parent
        assert read_image(frame.path).shape == (32, 32, 3)
        assert read_mask(folder / "masks_in" / frame.path.name).any()
        assert not read_mask(folder / "masks_out" / frame.path.name).any()
        assert np.load(folder / "depth" / f"{frame.path.stem}.npz")["depth"].shape == (32, 32)
    assert json.loads((tmp_path / "truth" / "change.json").read_text())["objects"][0]["new_from_old"] is None


def test_bad_requests_are_refused_before_any_work(tmp_path):
    with pytest.raises(InputError, match="cube, cylinder"):
        write_world("cubes", tmp_path / "x")
    with pytest.raises(InputError, match="cameras"):
        SynthConfig(cameras=9)
    assert not (tmp_path / "x").exists()


def test_any_seed_is_one_of_the_renderer(tracer):
    world = WORLDS["cube"](0)
    pose = ring(world.target)[0]
    first, same, other = (tracer(world.before).photo(square_camera(8), pose, 1, s) for s in (7, 7 + 2**32, 8))
    # threads add a pixel's samples in any order: the same photo to its last bits only
    torch.testing.assert_close(first, same, atol=1e-4, rtol=0)
    assert (first - other).abs().max() > 1e-2
