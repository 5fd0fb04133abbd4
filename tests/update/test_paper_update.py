"""The paper's update: who answers for a sample, where proposals look, which pixels teach, and what learns."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from refield.artefacts import read_tensors, write_tensors
from refield.commands.options import kind_of, parsed
from refield.commands.train import _config_of
from refield.commands.update import _by_route
from refield.field.fit import FitConfig
from refield.field.fit_nerfacto import REDUCED, NerfactoFitConfig
from refield.field.nerfacto import NerfactoField
from refield.field.render import render_rays
from refield.field.warp import move_in, two_way
from refield.history import known_objects, retouched
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, Rays
from refield.scene.change import ObjectChange, PlacedPhoto, SceneChange
from refield.scene.errors import InputError
from refield.scene.images import write_image
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.fit_helper import UpdateProgress
from refield.update.paper import training
from refield.update.paper.config import PaperUpdateConfig, reduced
from refield.update.paper.field import PaperField, begun, ready
from refield.update.paper.lessons import lessons, masked
from refield.update.paper.route import need_nerfacto, update_field_paper
from refield.update.store import load_updated, save_updated
from refield.update.supervision import places_of
from refield.update.train import update_field
from refield.vision.pixels import dilate
from tests.captures import looking_at
from tests.field.test_nerfacto import small_nerfacto, some_rays
from tests.fields import small_field
from tests.update.worlds import Ball, at, grid_of, moved

CAMERA = Camera(100, 80, 110.0, 110.0, 50.0, 40.0)
BALL, THERE = Ball(at(0.0, 0.0, 0.0), 0.3), at(1.2, 0.3, 0.0, yaw=0.5)
MOVE = moved(BALL, THERE)
FEW = PaperUpdateConfig(steps=3, rays=64, look=4, check_every=2)


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


def frames(folder: Path, count: int, turn: float = 0.0) -> tuple[Frame, ...]:
    """Photos of noise around the scene."""
    out = []
    for i in range(count):
        a = 2 * math.pi * i / count + turn
        eye = torch.tensor([3 * math.cos(a), 3 * math.sin(a), 1.0], dtype=torch.float64)
        name = f"{turn}-{i}.png"
        write_image(folder / name, torch.rand(CAMERA.height, CAMERA.width, 3))
        out.append(Frame(folder / name, CAMERA, name, looking_at(eye, torch.zeros(3, dtype=torch.float64))))
    return tuple(out)


@pytest.fixture
def scene(tmp_path: Path) -> tuple[Capture, SceneChange]:
    """Old photos and new ones; an object that moved, seen as its projection."""
    old, new = frames(tmp_path, 5), frames(tmp_path, 2, turn=0.4)
    photos = tuple(PlacedPhoto(f.name, "used", frame=f) for f in new)
    return Capture(old, held_out_every=0), SceneChange((MOVE,), photos)


def before_training(seed: int = 1) -> PaperField:
    """A helper by chance, with something to see in it."""
    field = begun(small_nerfacto(), SceneChange((MOVE,)), (3, 4), 2.5, seed)
    with torch.no_grad():
        field.helper.trunk.encoding.tables.normal_(generator=torch.Generator().manual_seed(seed))
    return ready(field)


def points(count: int = 4000) -> tuple[Tensor, Tensor]:
    x = torch.rand(count, 3) * 4 - torch.tensor([1.5, 2.0, 2.0])
    return x, torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)


# --- who answers ------------------------------------------------------------------------------------------------------


def test_each_sample_is_answered_by_helper_or_old_field() -> None:
    field = before_training()
    x, d = points()
    sigma, rgb = field(x, d)
    asked, along, owner = move_in(x, d, field.moves)
    helped = (owner < 0) & BALL_REGION.contains(x)
    assert helped.any() and (owner == 0).any() and (~helped & (owner < 0)).any()
    for part, (s, c) in ((helped, field.helper(x, d)), (~helped, field.pretrained(asked, along))):
        torch.testing.assert_close(sigma[part], s[part])
        torch.testing.assert_close(rgb[part], c[part])
    torch.testing.assert_close(field.density(x), sigma)


BALL_REGION = grid_of(BALL).dilated(2.5)


def test_where_places_overlap_what_moved_in_wins() -> None:
    near = SceneChange((moved(BALL, at(0.2, 0.0, 0.0)),))
    field = ready(begun(small_nerfacto(), near, (3, 4), 2.5, 0))
    x, d = points()
    both = field.moves[0].arrived(x) & field.region.contains(x)
    asked, along, _ = move_in(x, d, field.moves)
    assert both.any()
    torch.testing.assert_close(field(x, d)[1][both], field.pretrained(asked, along)[1][both])


def test_looks_are_the_helpers_alone_and_a_picture_shows_their_mean() -> None:
    field = before_training()
    x, d = points()
    one, other = (field.seen_in(torch.full((len(x),), i), x, d) for i in (0, 2))
    helped = field.region.contains(x) & ~field.moves[0].arrived(x)
    assert torch.equal(one[0], other[0])  # a look changes no shape
    assert torch.equal(one[1][~helped], other[1][~helped])
    assert ((one[1] - other[1]).abs().amax(-1)[helped] > 1e-3).float().mean() > 0.9
    with torch.no_grad():
        field.helper.looks[:] = field.helper.looks.mean(0)
    torch.testing.assert_close(field(x, d)[1], field.seen_in(torch.zeros(len(x), dtype=torch.long), x, d)[1])


# --- where proposals look ---------------------------------------------------------------------------------------------


def test_proposals_are_asked_both_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    """They know the ball at its old place alone: rays look for it at the new one, and no longer at the old one."""

    def told_by(self: NerfactoField, network: object) -> object:
        return lambda x: torch.where(x.norm(dim=-1) < 0.3, 60.0, 0.0)

    monkeypatch.setattr(NerfactoField, "told_by", told_by)
    field = begun(small_nerfacto(), SceneChange((MOVE,)), (1, 4), 2.5, 0)
    down = torch.tensor([[0.0, 0.0, -1.0]])
    old, new = torch.tensor([[0.0, 0.0, 3.0]]), torch.tensor([[1.2, 0.3, 3.0]])
    rays = Rays(torch.cat([old, new]), down.expand(2, 3))
    told, _ = field.propose(rays)
    for histogram in told:
        assert float(histogram.weights[0].sum()) < 1e-3 < 0.9 < float(histogram.weights[1].sum())
    samples = field.samples(rays)
    z = samples.positions(rays)[0][:, 2]
    near = z.abs() < 0.4
    assert int(near[samples.ray_ids == 1].sum()) > 2 * int(near[samples.ray_ids == 0].sum())
    x, d = points()
    assert torch.equal(field.proposed_at(x), two_way(x, d, field.moves)[0])


# --- what teaches -----------------------------------------------------------------------------------------------------


def test_three_masks_leave_a_ring(scene: tuple[Capture, SceneChange]) -> None:
    capture, _ = scene
    out, now = torch.zeros(80, 100, dtype=torch.bool), torch.zeros(80, 100, dtype=torch.bool)
    out[30:50, 40:60], now[30:40, 70:75] = True, True
    unsure = replace(MOVE, masks=(out, None, out, out, out), masks_in=(now,) * 5)
    places = places_of(SceneChange((unsure,)))
    ring = masked(places, 0, capture.frames[0], PaperUpdateConfig())
    assert ring is not None
    wanted = dilate(out.numpy(), 15) & ~dilate(out.numpy(), 1) & ~now.numpy()  # 0.15 and 0.01 of 100 pixels
    assert np.array_equal(ring.numpy(), wanted) and (now.numpy() & dilate(out.numpy(), 15)).any()
    assert masked(places, 1, capture.frames[1], PaperUpdateConfig()) is None


def test_one_bank_holds_new_photos_whole_and_old_ones_masked(scene: tuple[Capture, SceneChange]) -> None:
    capture, change = scene
    silhouettes = places_of(change)
    sure = tuple(torch.from_numpy(silhouettes.was[0].silhouette(f)) for f in capture.frames)
    unsure = replace(MOVE, masks=(sure[0], None, *sure[2:]))
    change = replace(change, objects=(unsure,))
    bank = lessons(capture.train, change, FEW)
    named = [f.name for f in bank.frames]
    assert named == [f.name for i, f in enumerate(capture.frames) if i != 1] + [f.name for f in change.frames]
    counts = bank.starts.diff().tolist()
    assert counts[-2:] == [8000, 8000]
    for i, count in zip((0, 2, 3, 4), counts):
        ring = masked(places_of(change), i, capture.frames[i], FEW)
        assert ring is not None and count == int(ring.sum()) > 0


def test_batches_are_drawn_from_all_pixels_alike(
    scene: tuple[Capture, SceneChange], monkeypatch: pytest.MonkeyPatch
) -> None:
    capture, change = scene
    drawn: list[Tensor] = []
    was = training.PaperTraining._loss

    def loss(self: training.PaperTraining, pixels: Tensor, learning: bool) -> Tensor:
        drawn.append(pixels)
        return was(self, pixels, learning)

    monkeypatch.setattr(training.PaperTraining, "_loss", loss)
    update_field_paper(capture, small_nerfacto(), change, replace(FEW, steps=4, rays=500))
    bank = lessons(capture.train, change, FEW)
    share = (torch.cat(drawn) >= bank.starts[-3]).float().mean()  # of the two new photos
    assert float(share) == pytest.approx(16000 / len(bank), abs=0.05) and torch.cat(drawn).max() < len(bank)


# --- what learns ------------------------------------------------------------------------------------------------------


def test_the_old_field_is_frozen_and_the_rest_learns(scene: tuple[Capture, SceneChange]) -> None:
    capture, change = scene
    old = small_nerfacto()
    kept = {k: v.clone() for k, v in old.state_dict().items()}
    fresh = begun(old, change, (7, FEW.look), FEW.dilation, FEW.seed)
    stages: list[str] = []
    looks: list[UpdateProgress] = []
    field = update_field_paper(capture, old, change, FEW, stages.append, looks.append)
    assert all(torch.equal(v, kept[k]) for k, v in old.state_dict().items())
    assert not any(p.requires_grad for p in (*old.parameters(), *field.helper.parameters()))
    for now, first in ((field.helper, fresh.helper), (field.proposals, old.proposals)):
        for (name, p), q in zip(now.named_parameters(), first.parameters(), strict=True):
            assert not torch.equal(p, q), name
    assert stages == ["supervise", "train", "show"] and field.why_stopped == "all steps done"
    assert [look.step for look in looks] == [2] and math.isnan(looks[0].psnr)
    torch.manual_seed(5)
    again, drawn = update_field_paper(capture, old, change, FEW), torch.rand(1)
    assert torch.equal(again.helper.looks, field.helper.looks)  # by the seed alone
    torch.manual_seed(5)
    assert torch.equal(drawn, torch.rand(1)), "torch's own generator was drawn from"


def test_training_shows_the_photos_better(scene: tuple[Capture, SceneChange]) -> None:
    """New photos of plain red and an old field that is all but empty: the helper becomes red and solid."""
    capture, change = scene
    red = torch.tensor([0.9, 0.1, 0.2])
    for frame in change.frames:
        write_image(frame.path, red.expand(CAMERA.height, CAMERA.width, 3))
    unseen = replace(MOVE, masks=(torch.zeros(80, 100, dtype=torch.bool),) * 5)  # old photos teach nothing
    change = replace(change, objects=(unseen,))
    old = small_nerfacto()
    empty = NerfactoField(old.config, old.sampler).eval().requires_grad_(False)
    eye = change.frames[0].centre.float()
    rays = Rays(eye[None], torch.nn.functional.normalize(-eye, dim=0)[None])

    def off(steps: int) -> float:
        field = update_field_paper(capture, empty, change, replace(FEW, steps=steps, rays=256))
        return float((render_rays(field, rays).rgb - red).abs().max())

    assert off(60) < 0.5 * off(0)


def test_it_ends_in_time(scene: tuple[Capture, SceneChange]) -> None:
    field = update_field_paper(*_args(scene), replace(FEW, steps=10**6, max_seconds=0.2))
    assert field.why_stopped == "out of time"


def _args(scene: tuple[Capture, SceneChange]) -> tuple[Capture, NerfactoField, SceneChange]:
    return scene[0], small_nerfacto(), scene[1]


def test_what_cannot_be_updated_so_is_told(scene: tuple[Capture, SceneChange]) -> None:
    capture, change = scene
    route = UpdateConfig(route="paper", paper=FEW)
    with pytest.raises(InputError, match=r"HashField.*refield train DATA WORK --route"):
        update_field(capture, small_field(), change, route)
    with pytest.raises(InputError, match=r"refield's own route.*refield undo"):
        need_nerfacto(UpdatedField(small_nerfacto(), SceneChange((MOVE,))), "work")
    with pytest.raises(InputError, match="no new photos"):
        update_field(capture, small_nerfacto(), SceneChange((MOVE,)), route)


# --- kept, and updated again ------------------------------------------------------------------------------------------


def test_saved_is_read_back(scene: tuple[Capture, SceneChange], tmp_path: Path) -> None:
    capture, old, change = _args(scene)
    field = update_field(capture, old, change, UpdateConfig(route="paper", paper=FEW))
    assert isinstance(field, PaperField)
    save_updated(tmp_path, field)
    back = load_updated(tmp_path, old, change)
    rays = some_rays()
    for key in ("rgb", "depth", "opacity"):
        assert torch.equal(getattr(render_rays(field, rays), key), getattr(render_rays(back, rays), key))
    assert torch.equal(field.sampler.grid, back.sampler.grid)
    tensors, facts = read_tensors(tmp_path)
    write_tensors(tmp_path, {k: v for k, v in tensors.items() if k != "helper.looks"}, facts)
    with pytest.raises(InputError, match=r"looks"):
        load_updated(tmp_path, old, change)
    write_tensors(tmp_path, tensors, facts)
    with pytest.raises(InputError, match="HashField"):
        load_updated(tmp_path, small_field(), change)


def test_a_second_visit_builds_on_the_first(scene: tuple[Capture, SceneChange], tmp_path: Path) -> None:
    capture, old, change = _args(scene)
    once = update_field_paper(capture, old, change, FEW)
    grid = grid_of(Ball(THERE, BALL.radius))
    on = replace(change, objects=(ObjectChange("moved", grid, at(-0.2, -1.0, 0.1)),))
    now = retouched(capture, once, tmp_path / "now")
    assert all(f.made is not None for f in now.frames)  # the old photos, brought up to date
    twice = update_field_paper(capture, once, on, FEW)
    assert twice.base is old and twice.pretrained is once
    x = torch.randn(200, 3) * 0.05
    there = x + THERE[:3, 3].float() + torch.tensor([-0.2, -1.0, 0.1])
    torch.testing.assert_close(twice.proposed_at(there), move_in(x + THERE[:3, 3].float(), x, once.moves)[0])
    torch.testing.assert_close(twice.density(there), old.density(twice.proposed_at(there)))
    save_updated(tmp_path, twice)
    back = load_updated(tmp_path, once, on)
    rays = some_rays()
    assert torch.equal(render_rays(twice, rays).rgb, render_rays(back, rays).rgb)
    assert [tuple(k.grid.aabb.shape) for k in known_objects(twice)] == [(2, 3)]


def test_refields_own_update_builds_on_it(scene: tuple[Capture, SceneChange], tmp_path: Path) -> None:
    capture, old, change = _args(scene)
    once = update_field_paper(capture, old, change, FEW)
    on = SceneChange((ObjectChange("moved", grid_of(Ball(THERE, BALL.radius)), at(-0.2, -1.0, 0.1)),), by_hand=True)
    twice = update_field(capture, once, on)
    assert isinstance(twice, UpdatedField) and twice.pretrained is once
    save_updated(tmp_path, twice)
    rays = some_rays()
    assert torch.equal(render_rays(twice, rays).rgb, render_rays(load_updated(tmp_path, once, on), rays).rgb)
    with pytest.raises(InputError, match="refield undo"):
        update_field_paper(capture, twice, change, FEW)


# --- the commands' options --------------------------------------------------------------------------------------------


def test_one_option_chooses_both_halves() -> None:
    def routes(*words: str) -> tuple[str, str]:
        estimate, update = _by_route(parsed(kind_of("update"), ["w", "p", *words], "update"))
        return estimate.route, update.route

    assert routes() == ("refield", "refield")
    assert routes("--route", "paper") == ("paper", "paper")
    assert routes("--route", "paper-reduced") == ("paper", "paper-reduced")
    assert routes("--route", "refield", "--update.route", "paper") == ("refield", "refield")
    assert routes("--update.route", "paper") == ("refield", "paper")
    assert routes("--estimate.route", "paper") == ("paper", "refield")


def test_training_for_the_route_is_nerfactos() -> None:
    def config(*words: str) -> FitConfig | NerfactoFitConfig:
        return _config_of(parsed(kind_of("train"), ["d", "w", *words], "train"))

    paper, small = config("--route", "paper"), config("--route", "paper-reduced", "--nerfacto.seed", "3")
    assert isinstance(paper, NerfactoFitConfig) and isinstance(small, NerfactoFitConfig)
    assert paper.field == NerfactoFitConfig().field and paper.photos.exposures is False
    assert small.field == REDUCED.field and small.seed == 3 and small.photos.exposures is False
    assert config("--architecture", "nerfacto") == NerfactoFitConfig()
    assert isinstance(config(), FitConfig)


def test_reducing_changes_the_schedule_alone() -> None:
    own = PaperUpdateConfig(dilation=2.0, seed=5)
    changed = {f.name for f in fields(own) if getattr(own, f.name) != getattr(reduced(own), f.name)}
    assert changed == {"rays", "decay_steps"}
