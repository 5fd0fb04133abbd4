"""The training loop on a little scene in closed form, and the default field's files."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numba.core import event
from PIL import Image

from refield.field import kernels
from refield.field.attempts import ASKED, ENDLESS, Attempts, Patience, StuckError
from refield.field.compiling import compiling
from refield.field.descent import MOST_SKIPPED, NonFiniteError
from refield.field.encoding import Contraction
from refield.field.fit import FitConfig, FitProgress, _Fit, fit_field
from refield.field.memory import memory_of
from refield.field.photos import HeldOut, Photos, Since
from refield.field.pixels import PixelBank
from refield.field.placing import opened, place_contraction
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.render import render_frame, render_many, render_rays
from refield.field.sampling import IN_PICTURES
from refield.field.schedule import rate_factor
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.change import OccupancyGrid
from refield.scene.errors import InputError
from refield.scene.images import frame_image
from refield.scene.pose import rigid

CAMERA = Camera(32, 32, 34.0, 34.0, 16.0, 16.0)
TINY = FitConfig(
    steps=400,
    samples=4096,
    check_every=200,
    field=HashFieldConfig(levels=6, finest=64, log2_table=12),
    finest_auto=False,
)


def looking_at(centre: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    forward = torch.nn.functional.normalize(target - centre, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0, 1]).double()), dim=0)
    return rigid(torch.stack([right, torch.linalg.cross(forward, right), forward], 1), centre)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A coloured ball in front of a striped, far wall, in 60 views."""
    folder = tmp_path_factory.mktemp("ball")
    frames = []
    for i in range(60):
        a = torch.tensor(i * 0.8, dtype=torch.float64)
        centre = torch.stack([2 * a.cos(), 2 * a.sin(), 0.3 + 0.02 * torch.tensor(float(i)).double()])
        pose = looking_at(centre, torch.zeros(3, dtype=torch.float64))
        rays = camera_rays(CAMERA, pose)
        b = (rays.origins * rays.directions).sum(-1)
        inside = b * b - (rays.origins.square().sum(-1) - 0.5**2)
        hit = rays.origins + rays.directions * (-b - inside.clamp_min(0).sqrt())[:, None]
        ball = 0.5 + 0.4 * torch.sin(9 * hit)
        wall = (torch.sin(2 * rays.directions) * 0.25 + 0.5).abs()
        rgb = torch.where((inside > 0)[:, None], ball, wall).reshape(32, 32, 3).clamp(0, 1)
        path = folder / f"{i:02d}.png"
        Image.fromarray((rgb * 255).round().numpy().astype(np.uint8)).save(path)
        frames.append(Frame(path, CAMERA, path.name, pose))
    return Capture(tuple(frames))


@pytest.fixture(scope="module")
def fitted(capture: Capture) -> tuple[HashField, list[FitProgress]]:
    looks: list[FitProgress] = []
    return fit_field(capture, TINY, looks.append), looks


def test_pictures_have_shorter_samples_than_a_fit(fitted: tuple[HashField, list[FitProgress]]) -> None:
    field, _ = fitted
    assert field.sampler.per_step == IN_PICTURES > 1
    assert field.sampler.lattice[2] == field.sampler.step / IN_PICTURES
    tensors, facts = field.state()
    assert HashField.from_state(tensors, facts).sampler.per_step == IN_PICTURES
    facts["sampler"].pop("per_step")  # as written by older versions
    assert HashField.from_state(tensors, facts).sampler.lattice[2] == field.sampler.step
    assert opened(field).sampler.per_step == 1  # a fit that goes on


def test_shorter_samples_are_nearer_to_the_mean_over_where_samples_lie(
    capture: Capture, fitted: tuple[HashField, list[FitProgress]]
) -> None:
    field = HashField.from_state(*fitted[0].state())
    rays = camera_rays(CAMERA, capture.held_out[0].world_from_cam)
    short = render_many(field, rays).rgb
    field.sampler = replace(field.sampler, per_step=1.0)
    torch.manual_seed(4)
    with torch.no_grad():
        mean = torch.stack([render_rays(field, rays, jitter=True).rgb for _ in range(16)]).mean(0)
    assert (short - mean).square().mean() < 0.8 * (render_many(field, rays).rgb - mean).square().mean()


def test_dim_photos_are_fitted_nearly_as_well(
    capture: Capture, fitted: tuple[HashField, list[FitProgress]], tmp_path: Path
) -> None:
    """In proportion to their colours; with a distortion loss that does not heed them, 9 dB less well."""
    part = 0.3
    for frame in capture.frames:
        Image.fromarray((frame_image(frame).numpy() * part).round().astype(np.uint8)).save(tmp_path / frame.name)
    dim = Capture(tuple(replace(f, path=tmp_path / f.name) for f in capture.frames))
    looks: list[FitProgress] = []
    fit_field(dim, TINY, looks.append)
    assert looks[-1].psnr + 20 * math.log10(part) > fitted[1][-1].psnr - 1.5


def test_brightness_is_told_beside_what_is_barely_dim(tmp_path: Path) -> None:
    def of(grey: int) -> float:
        Image.fromarray(np.full((32, 32, 3), grey, np.uint8)).save(tmp_path / f"{grey}.png")
        pose = torch.eye(4, dtype=torch.float64)
        return PixelBank([Frame(tmp_path / f"{grey}.png", CAMERA, "grey", pose)]).brightness

    assert of(42) == pytest.approx(0.5, abs=0.01) and of(1) == 0.1 and of(0) == of(92) == of(255) == 1


def test_held_out_views_are_explained(capture: Capture, fitted: tuple[HashField, list[FitProgress]]) -> None:
    field, looks = fitted
    truth = torch.stack([frame_image(f) for f in capture.held_out]).float() / 255
    blank = -10 * float((truth - truth.mean((0, 1, 2))).square().mean().log10())
    assert looks[-1].psnr > blank + 4
    assert len(looks) >= 2 and looks[-1].rays_per_second > 0
    view = render_frame(field, capture.held_out[0])
    assert view.opacity.mean() > 0.9


def test_a_fit_that_leads_nowhere_begins_anew(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    short = replace(TINY, steps=20, check_every=20, field=replace(TINY.field, levels=2, log2_table=8))
    monkeypatch.setattr("refield.field.fit.ASKED", (1, 3, 5))
    other = fit_field(capture, replace(short, seed=short.seed + 1))
    asked: list[int] = []
    monkeypatch.setattr(Patience, "ends", lambda patience, step, *_: asked.append(step) or len(asked) == 2)
    again = fit_field(capture, short)
    assert asked == [3, 5, 3, 5]  # the first look is no question
    assert all(torch.equal(a, b) for a, b in zip(again.parameters(), other.parameters()))
    with monkeypatch.context() as patch:
        patch.setattr(Patience, "ends", lambda *_: True)
        told = iter([0.0, 1.0, 0.0, 3.0, 0.0, 2.0, 0.0, 0.0])
        patch.setattr(HeldOut, "psnr", lambda judge, model, exposed=False: next(told, 0.0))
        last = fit_field(capture, short)  # of four that were given up the best is fitted to its end
    assert all(torch.equal(a, b) for a, b in zip(last.parameters(), other.parameters()))
    asked.clear()
    monkeypatch.setattr("refield.field.attempts.LATER_STEPS", (3, 5))
    monkeypatch.setattr("refield.field.attempts.LATE", 0.0)
    fit_field(capture, short)
    assert asked == []  # too late to begin anew: it goes on with what it has


def attempts(capture: Capture, config: FitConfig) -> int:
    """How often a fit begins."""
    steps: list[int] = []
    fit_field(capture, config, on_step=lambda step, field: steps.append(step))
    return steps.count(1)


def rephotographed(capture: Capture, folder: Path, change: Callable[[torch.Tensor, int], torch.Tensor]) -> Capture:
    """The same cameras with other pictures, each made of the old one, (H, W, 3) in [0, 1], and its number."""
    frames = []
    for i, frame in enumerate(capture.frames):
        rgb = change(frame_image(frame).float() / 255, i).clamp(0, 1)
        path = folder / frame.path.name
        Image.fromarray((rgb * 255).round().numpy().astype(np.uint8)).save(path)
        frames.append(replace(frame, path=path))
    return replace(capture, frames=tuple(frames))


def test_photos_learnt_by_heart_are_begun_anew(capture: Capture, tmp_path: Path) -> None:
    """Pictures that have nothing to do with each other: what one teaches is no use to another."""

    def unrelated(photo: torch.Tensor, i: int) -> torch.Tensor:
        blocks = torch.rand(1, 3, 4, 4, generator=torch.Generator().manual_seed(i))
        return torch.nn.functional.interpolate(blocks, photo.shape[:2], mode="bilinear")[0].permute(1, 2, 0)

    few = replace(capture, frames=capture.frames[:20])
    short = replace(TINY, steps=510, samples=1024, check_every=1000, field=replace(TINY.field, levels=4))
    assert attempts(rephotographed(few, tmp_path, unrelated), short) == 5


def test_bad_photos_of_a_scene_are_fitted_once(capture: Capture, tmp_path: Path) -> None:
    """Grain that no field can explain: the error stays large, and hardly falls once the scene is learnt."""

    def grainy(photo: torch.Tensor, i: int) -> torch.Tensor:
        return photo + 0.2 * torch.randn(photo.shape, generator=torch.Generator().manual_seed(i))

    assert attempts(rephotographed(capture, tmp_path, grainy), replace(TINY, steps=510, check_every=1000)) == 1


def test_same_seed_same_field(capture: Capture) -> None:
    short = replace(TINY, steps=24)
    a, b = fit_field(capture, short), fit_field(capture, short)
    for x, y in zip(a.state_dict().values(), b.state_dict().values()):
        assert torch.equal(x, y)
    assert torch.equal(a.sampler.grid, b.sampler.grid)


def test_field_survives_its_files(fitted: tuple[HashField, list[FitProgress]], tmp_path: Path) -> None:
    field, _ = fitted
    field.save(tmp_path)
    again = HashField.load(tmp_path)
    x, d = torch.randn(1000, 3), torch.nn.functional.normalize(torch.randn(1000, 3), dim=-1)
    for a, b in zip(field(x, d), again(x, d)):
        assert torch.equal(a, b)
    torch.testing.assert_close(field.density(x), field(x, d)[0], rtol=1e-4, atol=1e-3)
    (tmp_path / "field.json").write_text("{}")
    with pytest.raises(InputError, match="holds no readable field"):
        HashField.load(tmp_path)


def test_density_is_zero_where_the_sampler_does_not_look(fitted: tuple[HashField, list[FitProgress]]) -> None:
    field, _ = fitted
    x = torch.randn(5000, 3) * 2
    dark = ~field.sampler.occupied(x)
    assert dark.any() and field.density(x)[dark].abs().max() == 0


def test_gradients_reach_positions_and_directions(fitted: tuple[HashField, list[FitProgress]]) -> None:
    """Of a smooth sum over the field, against central differences."""
    field, _ = fitted
    torch.manual_seed(0)
    x = (torch.randn(400, 3) * 0.6).requires_grad_()
    d = torch.nn.functional.normalize(torch.randn(400, 3), dim=-1).requires_grad_()
    keep = field.sampler.occupied(x.detach())
    out = field(x, d)[1][keep].sum()
    to_x, to_d = torch.autograd.grad(out, [x, d])
    h = 1e-3
    direction = torch.randn(400, 3)
    with torch.no_grad():
        up, down = field(x + h * direction, d)[1][keep].sum(), field(x - h * direction, d)[1][keep].sum()
        assert abs(float((to_x * direction).sum() - (up - down) / (2 * h))) < 0.1 * float(to_x.abs().sum())
        up, down = field(x, d + h * direction)[1][keep].sum(), field(x, d - h * direction)[1][keep].sum()
    assert abs(float((to_d * direction).sum() - (up - down) / (2 * h))) < 0.1 * float(to_d.abs().sum())


def test_core_cube_lies_around_what_the_cameras_look_at(capture: Capture) -> None:
    space = place_contraction(capture)
    assert space.centre.norm() < 0.1
    assert 0.9 < space.radius < 1.8


def test_a_rig_that_looks_one_way_is_placed_by_its_points(capture: Capture) -> None:
    """Parallel axes meet nowhere; the reconstruction says how far the scene is."""
    frames = []
    for k in range(12):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:2, 3] = torch.tensor([0.1 * (k % 4), 0.1 * (k // 4)])
        frames.append(replace(capture.frames[0], world_from_cam=pose))
    g = torch.Generator().manual_seed(0)
    points = torch.rand(200, 3, generator=g) * 0.4 + torch.tensor([0.0, 0.0, 1.8])
    space = place_contraction(Capture(tuple(frames), points))
    assert abs(float(space.centre[2]) - 2.0) < 0.3 and 0.8 < space.radius < 1.6


@pytest.mark.parametrize(
    "looks, verdicts",
    [
        ([(100, 22.4, 26.1), (500, 32.2, 27.6), (750, 33.2, 26.5)], [False, False, True]),  # fell late
        ([(100, 23.3, 26.8), (500, 32.4, 32.7), (750, 33.6, 33.4)], [False, False, False]),
        ([(100, 22.0, 20.0), (500, 30.0, 20.3)], [False, True]),
        ([(100, 22.0, 20.0), (499, 30.0, 20.3), (1000, 33.0, 20.0)], [False, False, False]),  # not asked then
        ([(100, 22.0, 24.1), (400, 25.6, 25.3), (500, 25.9, 25.1)], [False, True, False]),  # a plain floor too near
        ([(100, 22.0, 23.8), (400, 28.2, 27.3)], [False, False]),  # a sound one
        ([(100, 22.0, math.nan), (400, 30.0, math.nan), (500, 31.0, math.nan)], [False, False, False]),
    ],
)
def test_what_is_learnt_by_heart_is_noticed_at_three_steps(
    looks: list[tuple[int, float, float]], verdicts: list[bool]
) -> None:
    """Steps done, PSNR of the photos that teach and of those left out; the first two are two seeds of one world."""
    fit: Any = SimpleNamespace(first=None, model=SimpleNamespace(train=lambda: None), _once_worked=lambda times: 0.0)
    fit.photos, found = SimpleNamespace(exposing=False), []
    for step, taught, left_out in looks:
        fit.steps_done, fit.loss = step, 10 ** (-taught / 10)
        fit.judge = SimpleNamespace(psnr=lambda *_, seen=left_out: seen)
        try:
            _Fit.give_up_if_stuck(fit, Attempts(None, 2000, True).patience)
            found.append(False)
        except StuckError as error:
            assert (error.left_out, error.step) == (left_out, step)
            found.append(True)
    assert found == verdicts


def test_two_ways_to_weigh_how_near_light_ends_are_compared_by_photos_left_out() -> None:
    def doubted(attempts: Attempts, left_out: float, gained: tuple[float, float] = (1.0, 4.0)) -> bool:
        return attempts.patience.ends(400, left_out, gained)

    better, worse = Attempts(None, 2000, True), Attempts(None, 2000, True)
    for attempts in (better, worse):
        assert attempts.nearness == 0 and doubted(attempts, 24.0) and not doubted(attempts, 24.0, (2.0, 4.0))
        attempts.give_up(StuckError(24.0, 400))
        assert attempts.nearness == 0.3 and attempts.seed == 0
    assert not doubted(better, 24.1) and doubted(worse, 24.0, (4.0, 4.0))
    worse.give_up(StuckError(24.0, 400))
    assert worse.nearness == 0 and worse.seed == 0 and not doubted(worse, 20.0)
    for attempts, nearness in ((better, 0.3), (worse, 0.0)):  # may be foam all the same; other seeds are asked anew
        for k, left_out in enumerate([23.0, 21.0, 22.0, 20.0], 1):
            assert attempts.patience.ends(500, 24.0, (0.1, 5.0)) and not attempts.patience.ends(500, 24.0, (1.0, 5.0))
            attempts.give_up(StuckError(left_out, 500))
            assert attempts.seed == (k if k < 4 else 0) and doubted(attempts, 10.0) == (k < 4)
        assert attempts.patience == ENDLESS and attempts.nearness == nearness
    for attempts in (Attempts(0.2, 2000, True), Attempts(None, 1000, True)):  # too few steps to begin anew so late
        assert not doubted(attempts, 10.0) and attempts.patience.ends(750, 24.0, (0.1, 5.0))
    assert Attempts(0.2, 2000, True).nearness == 0.2 and Attempts(None, 2000, False).patience == ENDLESS


def test_a_second_opinion_is_asked_only_if_it_will_be_judged_in_time() -> None:
    first = Attempts(None, 2000, True)
    asked = [(step, first.patience.is_late(step, lambda times: 0.1 * times)) for step in ASKED]
    assert asked == [(100, False), (400, False), (500, False), (750, False)]
    asked = [(step, first.patience.is_late(step, lambda times: 0.16 * times)) for step in ASKED]
    assert asked == [(100, False), (400, True), (500, False), (750, False)]
    first.give_up(StuckError(24.0, 400))  # it is judged, whatever the time
    asked = [(step, first.patience.is_late(step, lambda times: 0.5 * times)) for step in ASKED]
    assert asked == [(100, False), (400, False), (500, True), (750, True)]


def test_a_doubted_fit_is_tried_with_light_ending_farther_away(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("refield.field.fit.ASKED", (1, 3))
    monkeypatch.setattr("refield.field.attempts.DOUBT_STEP", 3)
    short = replace(TINY, steps=12, check_every=100, field=replace(TINY.field, levels=2, log2_table=8))
    plain, weighed = (fit_field(capture, replace(short, nearness=nearness)) for nearness in (0.0, 0.3))
    for told, chosen in (([20.0, 19.0, 20.0, 19.5], weighed), ([20.0, 19.0, 20.0, 18.5, 20.0], plain)):
        heard = iter(told)
        monkeypatch.setattr(HeldOut, "psnr", lambda judge, model, exposed=False, heard=heard: next(heard, 30.0))
        found = fit_field(capture, short)
        assert next(heard, None) is None
        assert all(torch.equal(a, b) for a, b in zip(found.parameters(), chosen.parameters()))
    assert any(not torch.equal(a, b) for a, b in zip(plain.parameters(), weighed.parameters()))


def test_how_near_light_ends_counts_while_a_fit_forms(
    capture: Capture, fitted: tuple[HashField, list[FitProgress]], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []
    whole = kernels.train_step
    monkeypatch.setattr(kernels, "train_step", lambda *a, **k: (asked.append(a[5].nearness), whole(*a, **k))[1])
    fit_field(capture, replace(TINY, steps=10, nearness=0.3))
    assert asked == pytest.approx([0.3 * max(1 - step / 4, 0) for step in range(10)])
    asked.clear()
    fit_field(capture, replace(TINY, steps=3, nearness=0.3), start=fitted[0])  # it knows how far away things are
    assert asked == [0, 0, 0]


def test_learning_rate_is_held_then_falls() -> None:
    assert rate_factor(0.0) == rate_factor(0.5) == 1
    assert 0.03 < rate_factor(1.0) < 0.04
    assert rate_factor(0.9) < rate_factor(0.7) < 1


def broken(monkeypatch: pytest.MonkeyPatch, bad: Callable[[int], bool], gradient: bool) -> list[int]:
    """Make the loss, or one of its gradients, NaN in chosen steps; the list holds the steps taken."""
    whole, steps = kernels.train_step, []

    def step(*args, **more):  # type: ignore[no-untyped-def]
        done = whole(*args, **more)
        steps.append(len(steps))
        if not bad(steps[-1]):
            return done
        if gradient:
            args[6][3][0, 0] = math.nan
            return done
        return done._replace(loss=math.nan)

    monkeypatch.setattr(kernels, "train_step", step)
    return steps


@pytest.mark.parametrize("gradient", [False, True])
def test_a_step_that_is_not_finite_is_left_out(
    capture: Capture, monkeypatch: pytest.MonkeyPatch, gradient: bool
) -> None:
    steps = broken(monkeypatch, lambda i: i % 3 == 1, gradient)
    field = fit_field(capture, replace(TINY, steps=60))
    assert len(steps) == 60
    assert all(bool(p.isfinite().all()) for p in field.parameters())


def test_training_that_stays_not_finite_stops_with_its_last_good_state(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = broken(monkeypatch, lambda i: i >= 150, gradient=False)
    with pytest.raises(NonFiniteError, match=f"{MOST_SKIPPED} steps in a row") as caught:
        fit_field(capture, replace(TINY, steps=400))
    assert len(steps) == 150 + MOST_SKIPPED
    field = caught.value.field
    assert field is not None and not field.training
    view = capture.held_out[0]
    error = (render_frame(field, view).rgb - frame_image(view).float() / 255).square().mean()
    assert -10 * math.log10(float(error)) > 15  # a field that had learnt something


def test_pixels_beyond_the_budget_are_drawn_from_every_photo(capture: Capture) -> None:
    whole, part = PixelBank(capture.train), PixelBank(capture.train, most=5000)
    assert len(part) <= 5000 < len(whole) and part.starts.diff().min() > 80
    mine = torch.randint(len(part), (200,))
    owner = part.frame_of(mine)
    assert part.places is not None
    same = whole.starts[owner] + part.places[mine]
    assert torch.equal(part.colours(mine), whole.colours(same))
    assert torch.equal(part.rays(mine).directions, whole.rays(same).directions)


def test_memory_is_known_before_it_is_taken(capture: Capture) -> None:
    needed = memory_of(capture, TINY)
    assert needed.photos == 3 * len(PixelBank(capture.train))
    held = memory_of(capture, replace(TINY, photo_memory=7e-6))
    assert held.photos == 7000 and len(PixelBank(capture.train, most=1000)) <= 1000
    assert "photos" in str(needed)
    fit_field(capture, replace(TINY, steps=20, photo_memory=7e-6))


def test_pixels_out_of_date_do_not_teach_and_newer_photos_do(capture: Capture) -> None:
    """Half of each old photo is painted over; the field never learns of it."""
    valid = {f.name: torch.arange(32)[None].expand(32, 32) < 16 for f in capture.frames}
    valid[capture.train[0].name] = torch.zeros(32, 32, dtype=torch.bool)
    photos = Photos.of(capture, Since(capture.train[-2:], valid))
    bank = photos.bank()
    whole = PixelBank(photos.train)
    assert len(bank) == 32 * 16 * (len(capture.train) - 1) + 2 * 1024
    assert int(bank.starts[1]) == 0  # nothing of the first
    chosen = torch.arange(0, len(bank), 37)
    owner = bank.frame_of(chosen)
    assert owner.min() == 1 and bank.places is not None
    same = whole.starts[owner] + bank.places[chosen]
    assert torch.equal(bank.colours(chosen), whole.colours(same))
    assert torch.equal(bank.rays(chosen).directions, whole.rays(same).directions)
    assert (bank.places[chosen] % 32 < 16)[owner < len(capture.train)].all()
    judge = photos.judge()
    assert judge.rays is not None and len(judge.rays) == 512 * len(capture.held_out)


def test_newer_photos_have_the_share_of_the_rays_that_they_are_to_have(capture: Capture) -> None:
    torch.manual_seed(0)
    since = Since(capture.train[-2:], share=0.25)
    photos = Photos.of(capture, since)
    bank, newer = photos.bank(), len(capture.train)
    drawn = bank.frame_of(photos.drawn(bank, 4000))
    assert int((drawn >= newer).sum()) == 1000 and drawn.unique().tolist() == [*range(newer + 2)]
    alike = replace(photos, since=replace(since, share=None))
    assert 50 < int((bank.frame_of(alike.drawn(bank, 4000)) >= newer).sum()) < 250  # 2 photos of 56
    none = {f.name: torch.zeros(32, 32, dtype=torch.bool) for f in capture.frames}
    alone = Photos.of(capture, replace(since, valid=none))
    assert len(alone.drawn(alone.bank(), 100)) == 100  # nothing old is left to draw


def test_photos_that_are_carried_along_teach_where_they_show_the_scene(capture: Capture) -> None:
    first = replace(capture.train[0], name="carried")
    half = torch.arange(32)[None].expand(32, 32) < 16
    photos = Photos.of(capture, Since(capture.train[-1:], {"carried": half}, carried=(first,), share=0.5))
    bank, carried = photos.bank(), len(capture.train)
    assert int(bank.starts[carried + 1] - bank.starts[carried]) == 512
    drawn = bank.frame_of(photos.drawn(bank, 1000))
    assert int((drawn == carried + 1).sum()) == 500 and (drawn == carried).any()


def test_what_is_known_to_be_empty_stays_empty(capture: Capture) -> None:
    """The ball is where nothing may be: the fit shows the photos worse, and shows them by something else."""
    box = torch.tensor([[-0.5] * 3, [0.5] * 3])
    ball = OccupancyGrid(box, torch.ones(4, 4, 4))
    field = fit_field(capture, replace(TINY, steps=100), since=Since(empty=(ball,)))
    inside = field.sampler.cells_in(box)
    inside = inside[ball.contains(field.sampler.points_in(inside, jitter=False))]
    assert len(inside) > 100 and not field.sampler.grid.reshape(-1)[inside].any()
    assert field.sampler.grid.any()


def test_colours_without_directions_are_the_same_from_everywhere(capture: Capture) -> None:
    x, d = torch.rand(50, 3) - 0.5, torch.nn.functional.normalize(torch.randn(2, 50, 3), dim=-1)
    for directions in (True, False):
        field = fit_field(capture, replace(TINY, steps=60, directions=directions))
        one, other = (field(x, way)[1] for way in d)
        assert torch.equal(one, other) != directions


def test_masks_and_a_budget_together(capture: Capture) -> None:
    half = torch.arange(32)[None].expand(32, 32) < 16
    bank = PixelBank(capture.train, most=5000, masks=[half] * len(capture.train))
    assert 4800 < len(bank) <= 5000 and bank.places is not None and (bank.places % 32 < 16).all()
    with pytest.raises(ValueError, match="of its own size"):
        PixelBank(capture.train, masks=[half[:5]] * len(capture.train))
    with pytest.raises(ValueError, match="of its own size"):
        PixelBank(capture.train, masks=[half])


def test_nothing_left_to_learn_from_is_said(capture: Capture) -> None:
    none = {f.name: torch.zeros(32, 32, dtype=torch.bool) for f in capture.frames}
    with pytest.raises(ValueError, match="no pixel"):
        fit_field(capture, TINY, since=Since(valid=none))


def test_pixels_on_a_device_are_the_banks(capture: Capture) -> None:
    pytest.importorskip("triton")
    from refield.field.graphed import DevicePixels

    half = torch.arange(32)[None].expand(32, 32) >= 16
    bank = PixelBank(capture.train, masks=[half, *([None] * (len(capture.train) - 1))])
    device = DevicePixels(bank, torch.device("cpu"))
    chosen = torch.arange(0, len(bank), 31)
    assert len(device) == len(bank)
    torch.testing.assert_close(device.rays(chosen).directions, bank.rays(chosen).directions)
    assert torch.equal(device.colours(chosen), bank.colours(chosen))


def test_what_triton_compiles_in_a_fit_within_a_fit_is_heard_by_both(monkeypatch: pytest.MonkeyPatch) -> None:
    knobs = pytest.importorskip("triton").knobs
    said: list[float] = []
    monkeypatch.setattr(knobs.compilation, "listener", lambda *, times, **_: said.append(times.total))
    with compiling(triton=True) as fit, compiling(triton=True) as look:
        knobs.compilation.listener(times=SimpleNamespace(total=2e6), cache_hit=False)
    knobs.compilation.listener(times=SimpleNamespace(total=1e6), cache_hit=False)
    assert fit.seconds == look.seconds == 2 and said == [2e6, 1e6]


def test_what_compiles_before_the_first_step_takes_no_time_from_the_fit(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a new machine the first look at the photos compiles every kernel, which can take longer than a whole draft."""

    later = [0.0]

    def compiles(capture: Capture, config: FitConfig) -> Contraction:
        with event.trigger_event("numba:compile"):
            later[0] += 1e6
        return place_contraction(capture)

    clock = SimpleNamespace(perf_counter=lambda: time.perf_counter() + later[0])
    monkeypatch.setattr("refield.field.compiling.time", clock)
    monkeypatch.setattr("refield.field.fit._core", compiles)
    looks: list[FitProgress] = []
    fit_field(capture, replace(TINY, steps=3, samples=512, max_seconds=1e5, look_around=True), looks.append)
    assert looks[-1].step == 3
