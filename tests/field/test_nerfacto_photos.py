"""What a fit of the NeRFacto shape finds out about its photos, by the model that the main one has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from refield.field.fit import FitProgress, Fitted
from refield.field.fit_nerfacto import NerfactoFitConfig, _NerfactoFit, fit_nerfacto
from refield.field.kernels.reference import Batch
from refield.field.nerfacto import NerfactoConfig, NerfactoField, ProposalConfig, looking_everywhere
from refield.field.photo_model import PhotoModelConfig
from refield.field.photos import Photos
from refield.field.placing import DIRECTED, place_contraction
from refield.field.proposal import even_edges
from refield.scene.capture import Capture, Rays
from refield.scene.exposure import Exposure
from tests.field.scenes import CAMERA, room
from tests.field.test_photo_model import VIGNETTING, apart, off_by, random_exposures

PROPOSAL = ProposalConfig(32, 24, coarsest=8, levels=3, log2_table=12, width=8)
SHAPE = NerfactoConfig(
    proposals=(PROPOSAL, replace(PROPOSAL, samples=20, finest=48)),
    samples=12,
    levels=4,
    coarsest=8,
    finest=48,
    log2_table=14,
    width=16,
    first_density=0.1,
    occupancy=32,
)
TINY = NerfactoFitConfig(steps=500, rays=384, final_rate=1e-3, decay_steps=500, distortion=1e-2, anneal_steps=100)
TINY = replace(TINY, check_every=10**6, field=SHAPE)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return room(tmp_path_factory.mktemp("room"))


def fitted(capture: Capture, steps: int, **asked: bool) -> tuple[Fitted[NerfactoField], float]:
    """What a fit found, and its PSNR on held-out photos, dB."""
    looks: list[FitProgress] = []
    config = replace(TINY, steps=steps, decay_steps=steps, photos=PhotoModelConfig(**asked))
    return fit_nerfacto(capture, config, looks.append), looks[-1].psnr


def run_of(capture: Capture, config: NerfactoFitConfig) -> _NerfactoFit:
    """A fit that has not begun."""
    torch.manual_seed(0)
    field = NerfactoField(SHAPE, looking_everywhere(place_contraction(capture), SHAPE))
    return _NerfactoFit(field, Photos.of(capture), config, None)


def test_exposures_are_found(plain: Capture, tmp_path: Path) -> None:
    put = random_exposures(len(plain.frames))
    capture = room(tmp_path, change=lambda photo, i: put[i].taken(photo, CAMERA))
    unaware = fitted(capture, 100)[1]
    found, psnr = fitted(capture, 500, exposures=True)
    assert psnr > unaware + 6
    of = {f.name: e for f, e in zip(capture.frames, put)}
    true = torch.tensor([of[f.name].gains for f in capture.train]).log()
    told = torch.tensor([f.exposure.gains for f in found.capture.train if f.exposure]).log()
    assert (told - (true - true.mean(0))).std() < 0.05
    left_out = torch.tensor([f.exposure.gains for f in found.capture.held_out if f.exposure]).log()
    there = torch.tensor([of[f.name].gains for f in capture.held_out]).log() - true.mean(0)
    assert (left_out - there).abs().max() < 0.1
    exposure = found.capture.frames[0].exposure
    assert exposure is not None
    fallen = replace(exposure, gains=(1.0, 1.0, 1.0)).factor(CAMERA)
    assert (fallen / Exposure(vignetting=VIGNETTING).factor(CAMERA)).log().abs().max() < 0.05


def test_photos_that_were_exposed_alike_are_left_alone(plain: Capture) -> None:
    found = fitted(plain, 150, exposures=True)[0]
    assert found.capture.frames == plain.frames


def test_while_exposures_are_found_colours_are_plain(plain: Capture) -> None:
    run = run_of(plain, replace(TINY, steps=100, photos=PhotoModelConfig(exposures=True)))
    columns = run.model.colour_in[:, -DIRECTED:]
    while run.done < 15:
        assert not columns.any()
        run._step(run.done)
        run.done += 1
    # they were exposed alike, which is known by now
    run._step(run.done)
    assert columns.any() and not run.photos.exposing


def test_poses_that_are_off_come_back(plain: Capture) -> None:
    given = off_by(1.5, plain)
    found = fitted(given, 500, poses=True)[0]
    before, after = (apart(c.train, plain.train).median() for c in (given, found.capture))
    assert after < 0.7 * before


def test_strangers_are_not_trusted(plain: Capture, tmp_path: Path) -> None:
    """A bright square passes through three of the photos."""
    spots = {3: (10, 12), 11: (25, 30), 22: (5, 30)}

    def passing(photo: Tensor, i: int) -> Tensor:
        if i in spots:
            row, column = spots[i]
            photo[row : row + 12, column : column + 12] = torch.tensor([1.0, 0.9, 0.1])
        return photo

    run = run_of(room(tmp_path, change=passing), replace(TINY, photos=PhotoModelConfig(trust=True)))
    run.run()
    trust, bank = run.photos.trust, run.photos.bank
    assert trust is not None
    every = torch.arange(len(bank))
    shown = trust.trust[trust.patches(every, bank.frame_of(every))].view(-1, CAMERA.height, CAMERA.width)
    inside = torch.zeros(shown.shape, dtype=torch.bool)
    names = [f.name for f in bank.frames]
    for i, (row, column) in spots.items():
        inside[names.index(f"{i:03d}.png"), row : row + 12, column : column + 12] = True
    assert shown[inside].mean() < 0.3 and shown[~inside].mean() > 0.9


# --- one step ---------------------------------------------------------------------------------------------------------


def a_batch(run: _NerfactoFit, count: int, **known: Tensor) -> tuple[Batch, Tensor]:
    """Rays of the capture, and where the field is asked."""
    chosen = torch.randint(len(run.photos.bank), (count,))
    rays = run.photos.bank.rays(chosen)
    lines = (rays.origins, rays.directions, torch.zeros(count))
    batch = Batch(lines, run.photos.bank.colours(chosen), torch.rand(count, 3))
    return batch._replace(**known), even_edges(count, SHAPE.samples, jitter=False)


def test_rays_tell_how_the_loss_changes_with_them(plain: Capture) -> None:
    run = run_of(plain, replace(TINY, gradient_unit=0.0))
    with torch.no_grad():
        run.model.trunk.encoding.tables.normal_().mul_(0.3)
    batch, edges = a_batch(run, 400, gains=torch.rand(400, 3) + 0.5, trust=torch.rand(400))
    given = Rays(*(r.requires_grad_() for r in batch.rays[:2]))
    loss, _ = run._compare(batch, given, edges)
    told = torch.autograd.grad(loss, [given.origins, given.directions])
    h = 2e-3
    for way in (0, 1):
        # along the gradient, so that the difference is far above what is lost to rounding
        along = told[way] / told[way].norm(dim=-1, keepdim=True).clamp_min(1e-9)
        ends = []
        with torch.no_grad():
            for sign in (1, -1):
                rays = [given.origins, given.directions]
                rays[way] = rays[way] + sign * h * along
                ends.append(run._compare(batch, Rays(*rays), edges)[0])
        torch.testing.assert_close((ends[0] - ends[1]) / (2 * h), (told[way] * along).sum(), rtol=0.1, atol=1e-6)


@pytest.mark.parametrize("background", ["random", "last_sample"])
def test_a_step_tells_what_was_seen(plain: Capture, background: str) -> None:
    run = run_of(plain, replace(TINY, background=background))
    with torch.no_grad():
        run.model.trunk.encoding.tables.normal_()
    gains, trust = torch.rand(50, 3) + 0.5, torch.rand(50)
    batch, edges = a_batch(run, 50, gains=gains, trust=trust)
    colours = batch.colours.clone()
    colours[:25] = 1.0  # burnt out
    batch = batch._replace(colours=colours)
    loss, done = run._compare(batch, Rays(*batch.rays[:2]), edges)
    assert done.shown is not None and done.errors is not None and done.heaviest is not None
    w = done.weights.view(50, -1)
    assert torch.equal(w.reshape(-1)[done.heaviest], w.amax(-1))
    assert torch.equal(done.heaviest // SHAPE.samples, torch.arange(50))
    behind = (1 - w.sum(-1, keepdim=True)) * batch.background if background == "random" else 0.0
    expected = gains * done.shown + behind - colours
    expected[:25] = expected[:25].clamp(max=0)
    torch.testing.assert_close(done.errors, expected, rtol=1e-4, atol=1e-5)
    bare = run_of(plain, replace(TINY, background=background, distortion=0.0))
    bare.model.load_state_dict(run.model.state_dict())
    of_colours = bare._compare(batch, Rays(*batch.rays[:2]), edges)[0]
    torch.testing.assert_close(of_colours, (trust[:, None] * done.errors.square()).mean())
    assert loss > of_colours
    x, _ = run.model.span.samples(edges).positions(Rays(*batch.rays[:2]))
    assert torch.equal(done.cells, run.model.sampler.cells(x))


def test_photos_are_read_at_the_size_that_is_asked(plain: Capture) -> None:
    half = replace(TINY, steps=2, size=replace(TINY.size, part=0.5))
    found = fit_nerfacto(plain, half)
    assert found.capture.frames == plain.frames
