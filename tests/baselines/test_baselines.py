"""Re-training and fine-tuning on a ball that moved, in closed form: what may teach them, and that they learn it."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from refield.baselines.curve import Curve, Point, looks_until, settled, time_to
from refield.baselines.finetune import finetune
from refield.baselines.material import material
from refield.baselines.retrain import retrain
from refield.baselines.told import carried_along, left_empty
from refield.field.fit import FitConfig, fit_field
from refield.field.radiance import Field, HashField, HashFieldConfig
from refield.field.render import render_camera, render_frame
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.change import PlacedPhoto, SceneChange
from refield.scene.images import frame_image, write_image
from refield.update.supervision import places_of
from tests.update.worlds import Ball, BallWorld, at, looking_from, moved

CAMERA = Camera(40, 40, 48.0, 48.0, 20.0, 20.0)
TINY = FitConfig(
    steps=200,
    samples=4096,
    check_every=200,
    field=HashFieldConfig(levels=6, finest=64, log2_table=12),
    finest_auto=False,
)
OLD, NEW = at(-0.3, 0.2, 0.25), at(0.4, -0.3, 0.25)
BEFORE, AFTER = BallWorld((Ball(OLD, 0.25),)), BallWorld((Ball(NEW, 0.25),))


def photographed(world: BallWorld, folder: Path, count: int, turn: float = 0.0) -> tuple[Frame, ...]:
    frames = []
    for i in range(count):
        pose = looking_from(turn + 2.4 * i, 2.8, 1.1 + 0.9 * (i % 3))
        path = folder / f"{i:02d}.png"
        write_image(path, render_camera(world, CAMERA, pose).rgb)
        frames.append(Frame(path, CAMERA, path.name, pose))
    return tuple(frames)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return Capture(photographed(BEFORE, tmp_path_factory.mktemp("before"), 24))


@pytest.fixture(scope="module")
def change(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> SceneChange:
    new = photographed(AFTER, tmp_path_factory.mktemp("after"), 4, turn=0.7)  # named like the old ones
    return SceneChange((moved(Ball(OLD, 0.25), NEW),), tuple(PlacedPhoto(f.name, "used", frame=f) for f in new))


@pytest.fixture(scope="module")
def old(capture: Capture) -> HashField:
    return fit_field(capture, TINY)


def error(field: Field, world: BallWorld, mask: torch.Tensor, frame: Frame) -> float:
    truth = render_camera(world, frame.camera, frame.world_from_cam).rgb
    return float((render_frame(field, frame).rgb - truth)[mask].square().mean())


def test_pixels_that_show_the_change_do_not_teach(capture: Capture, change: SceneChange) -> None:
    since, places = material(capture, change), places_of(change)
    assert since.frames == change.frames and set(since.valid) == {f.name for f in capture.frames}
    for frame in capture.frames:
        was, now = (torch.from_numpy(p[0].silhouette(frame)) for p in (places.was, places.now))
        valid = since.valid[frame.name]
        assert not (valid & (was | now)).any()
        assert valid.sum() > 0.6 * valid.numel()
        old, new = (render_camera(w, CAMERA, frame.world_from_cam).rgb for w in (BEFORE, AFTER))
        assert (old - new)[valid].abs().max() < 0.05


def test_an_unsure_mask_leaves_its_photo_out(capture: Capture, change: SceneChange) -> None:
    (ball,) = change.objects
    sure = [None] + [torch.zeros(40, 40, dtype=torch.bool) for _ in capture.train[1:]]
    unsure = replace(change, objects=(replace(ball, masks=tuple(sure)),))
    valid = material(capture, unsure).valid
    assert not valid[capture.train[0].name].any() and valid[capture.train[1].name].any()


def test_nothing_changed_masks_nothing(capture: Capture) -> None:
    assert not material(capture, SceneChange()).valid


def test_old_photos_carried_along_show_what_moved_where_it_is_now(capture: Capture, change: SceneChange) -> None:
    since = carried_along(capture, material(capture, change), change)
    assert len(since.carried) == len(capture.train) and since.frames == change.frames
    assert not {f.name for f in since.carried} & {f.name for f in capture.frames + change.frames}
    for frame in since.carried[::5]:
        mask = since.valid[frame.name]
        now, then = (render_camera(w, CAMERA, frame.world_from_cam).rgb for w in (AFTER, BEFORE))
        assert mask.sum() > 10
        assert (frame_image(frame) / 255 - now)[mask].abs().mean() < 0.02 < 0.05 < (now - then)[mask].abs().mean()


def test_what_does_not_move_is_not_carried_along(capture: Capture, change: SceneChange) -> None:
    (ball,) = change.objects
    gone = replace(change, objects=(replace(ball, kind="removed", new_from_old=None),))
    assert not carried_along(capture, material(capture, gone), gone).carried
    unsure = replace(change, objects=(replace(ball, masks=(None,) * len(capture.train)),))
    assert not carried_along(capture, material(capture, unsure), unsure).carried


def test_what_left_is_empty_but_for_its_rim_and_what_is_there_now(change: SceneChange) -> None:
    (empty,) = left_empty(change)
    middle, (x, y, z) = OLD[:3, 3].float(), (0.25, 0.0, 0.0)
    rim = middle + torch.tensor([x - 0.02, y, z])
    assert empty.contains(torch.stack([middle, rim, NEW[:3, 3].float()])).tolist() == [True, False, False]
    (ball,) = change.objects
    (near,) = left_empty(replace(change, objects=(replace(ball, new_from_old=at(0.3, 0, 0)),)))
    assert 0 < near.occupied().shape[0] < empty.occupied().shape[0]
    assert not left_empty(replace(change, objects=(replace(ball, kind="added", new_from_old=None),)))


@pytest.mark.parametrize("tuned", [False, True])
def test_the_new_state_is_learnt(tuned: bool, capture: Capture, change: SceneChange, old: HashField) -> None:
    kept = {k: v.clone() for k, v in old.state_dict().items()}
    longer = replace(TINY, steps=400)  # at 200 a last grey level in the photos decides whether it is learnt
    field = finetune(capture, old, change, longer) if tuned else retrain(capture, change, longer)
    frame = change.frames[0]
    now = torch.from_numpy(places_of(change).now[0].silhouette(frame))
    was = torch.from_numpy(places_of(change).was[0].silhouette(frame))
    for mask in (now, was):  # four photos of 40 x 40 pixels do not show much of what arrived
        assert error(field, AFTER, mask, frame) < 0.75 * error(old, AFTER, mask, frame)
    for name, value in old.state_dict().items():
        assert torch.equal(value, kept[name]), "the old field was changed"
    assert not field.training and field.sampler.grid.sum() < old.sampler.grid.numel() / 2


def test_fine_tuning_begins_where_the_old_field_ended(capture: Capture, change: SceneChange, old: HashField) -> None:
    first = replace(TINY, steps=1)
    tuned = finetune(capture, old, change, first)
    moved_by = (tuned.density_in - old.density_in).abs().max()
    assert 0 < moved_by <= 1.1 * TINY.rate
    assert tuned.config == old.config and tuned.contraction.radius == old.contraction.radius


def test_a_curve_is_scored_while_the_clock_stands(capture: Capture, change: SceneChange) -> None:
    def slow(field: Field) -> dict[str, float | None]:
        time.sleep(0.3)
        assert isinstance(field, HashField) and not field.training
        return {"psnr": float(field.density_in.detach().abs().sum())}

    steps = looks_until(12, 3)
    began = time.perf_counter()
    curve = Curve(slow, steps)
    field = retrain(capture, change, replace(TINY, steps=12), curve)
    whole = time.perf_counter() - began
    assert [p.step for p in curve.points] == [*steps, 12]
    assert curve.points[-1].seconds <= whole - 0.3 * len(curve.points) + 0.05
    assert all(a.seconds < b.seconds for a, b in zip(curve.points, curve.points[1:]))
    assert curve.points[-1].scores["psnr"] == float(field.density_in.abs().sum())


def test_a_fit_that_begins_anew_leaves_no_looks_behind(capture: Capture, change: SceneChange) -> None:
    curve = Curve(lambda f: {"d": float(f.density(torch.zeros(1, 3)))}, [2, 4, 6])
    field = retrain(capture, change, replace(TINY, steps=2))
    for step in (1, 2, 3, 4, 5, 1):  # the second attempt begins
        curve(step, field)
    assert curve.points == []
    for step in (2, 3, 4):
        curve(step, field)
    curve.look(4, field)
    assert [p.step for p in curve.points] == [2, 4, 4]


def test_the_same_with_and_without_a_curve(capture: Capture, change: SceneChange) -> None:
    short = replace(TINY, steps=20)
    a = retrain(capture, change, short)
    b = retrain(capture, change, short, Curve(lambda f: {"d": float(f.density(torch.zeros(1, 3)))}, [5, 10]))
    assert torch.equal(a.encoding.tables, b.encoding.tables)


def test_when_a_score_was_reached() -> None:
    points = [Point(1, 1.0, {"psnr": 20.0}), Point(2, 2.0, {"psnr": None}), Point(3, 3.0, {"psnr": 25.0})]
    assert time_to(points, "psnr", 20.0) == 1.0 and time_to(points, "psnr", 21.0) == 3.0
    assert time_to(points, "psnr", 26.0) is None and time_to(points, "ssim", 0.1) is None
    assert looks_until(2000, 16)[-1] < 2000 and len(looks_until(2000, 16)) == 16 and min(looks_until(5, 16)) == 1


def test_convergence_by_the_paper_s_rule() -> None:
    def curve(*ssim: float | None) -> list[Point]:
        return [Point(100 * k, 2.0 * k, {"ssim": v}) for k, v in enumerate(ssim)]

    rising = curve(0.1, 0.5, 0.8, 0.9, 0.9003, 0.9004, 0.9004)
    found = settled(rising, window=200)
    assert found is not None and (found.step, found.seconds) == (300, 6.0)
    assert settled(rising, window=400) is None  # nobody looked for so long
    assert settled(curve(0.1, 0.5, 0.8, 0.9, 0.95), window=100) is None  # it rose to the end
    late = settled(curve(0.5, 0.5, 0.9, 0.9), window=200)
    assert late is None  # a pause is no end
    assert settled(curve(None, None, None), window=100) is None
