"""What a fit finds out about its photos: exposures, poses and lenses, strangers in single photos."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from refield.field.fit import FitConfig, FitProgress, Fitted, _Fit, fit_capture
from refield.field.kernels.reference import Batch, Stepped
from refield.field.photo_model import PhotoModelConfig
from refield.field.photos import HeldOut, Photos
from refield.field.placing import new_field
from refield.field.poses import PoseFit
from refield.field.radiance import HashFieldConfig
from refield.field.render import render_frame
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.exposure import Exposure
from refield.scene.images import frame_image
from refield.scene.pose import invert, transform
from tests.field.scenes import CAMERA, photograph, poses, room, turned

SHAPE = HashFieldConfig(levels=4, coarsest=8, finest=48, log2_table=14, width=16)
TINY = FitConfig(steps=400, samples=4096, distortion=2e-3, check_every=10**6, field=SHAPE, finest_auto=False)
VIGNETTING = (-0.2, -0.1, 0.0)


def fitted(capture: Capture, steps: int = TINY.steps, **asked: bool) -> tuple[Fitted, float]:
    """What a fit found, and its PSNR on held-out photos, dB."""
    looks: list[FitProgress] = []
    found = fit_capture(capture, replace(TINY, steps=steps, photos=PhotoModelConfig(**asked)), looks.append)
    return found, looks[-1].psnr


@dataclass
class Plain:
    """The room as it is, and how well a fit does that is told nothing wrong."""

    capture: Capture
    psnr: float


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Plain:
    capture = room(tmp_path_factory.mktemp("room"))
    return Plain(capture, fitted(capture)[1])


# --- exposures --------------------------------------------------------------------------------------------------------


def random_exposures(count: int) -> list[Exposure]:
    logs = torch.rand(count, 3, generator=torch.Generator().manual_seed(5)) * 0.6 - 0.3
    return [Exposure((r, g, b), VIGNETTING) for r, g, b in logs.exp().tolist()]


def test_exposures_are_found(plain: Plain, tmp_path: Path) -> None:
    put = random_exposures(len(plain.capture.frames))
    capture = room(tmp_path, change=lambda photo, i: put[i].taken(photo, CAMERA))
    unaware = fitted(capture, 150)[1]
    found, psnr = fitted(capture, 600, exposures=True)
    assert psnr > plain.psnr - 0.5 and psnr > unaware + 5
    of = {f.name: e for f, e in zip(capture.frames, put)}
    true = torch.tensor([of[f.name].gains for f in capture.train]).log()
    logs = torch.tensor([f.exposure.gains for f in found.capture.train if f.exposure]).log()
    assert logs.mean(0).abs().max() < 1e-5
    assert (logs - (true - true.mean(0))).std() < 0.05
    left_out = torch.tensor([f.exposure.gains for f in found.capture.held_out if f.exposure]).log()
    there = torch.tensor([of[f.name].gains for f in capture.held_out]).log() - true.mean(0)
    assert (left_out - there).abs().max() < 0.1
    for frame in found.capture.frames:
        assert frame.exposure is not None
        fallen = replace(frame.exposure, gains=(1.0, 1.0, 1.0)).factor(CAMERA)
        assert (fallen / Exposure(vignetting=VIGNETTING).factor(CAMERA)).log().abs().max() < 0.05


def test_a_judge_of_unknown_exposures_heeds_no_gain(plain: Plain, tmp_path: Path) -> None:
    frames = plain.capture.held_out
    field = fitted(plain.capture, 120)[0].field
    lighter = Exposure((1.1, 1.3, 0.9))
    again = room(tmp_path, change=lambda photo, i: lighter.taken(photo, CAMERA)).held_out
    before, after = HeldOut(frames), HeldOut(again)
    # the same errors, but for how light they are
    assert after.psnr(field, exposed=True) == pytest.approx(before.psnr(field, exposed=True), abs=1.5)
    assert abs(after.psnr(field) - before.psnr(field)) > 0.2
    assert after.tells_exposures(field)
    gains = HeldOut(again).gains(field) / HeldOut(frames).gains(field)
    torch.testing.assert_close(gains, torch.tensor(lighter.gains).expand_as(gains), rtol=0.01, atol=0)


def test_a_judge_learns_of_lenses_and_vignetting(plain: Plain) -> None:
    frames = plain.capture.held_out
    lens = replace(CAMERA, fx=42.0, cx=25.0)
    judge = HeldOut(frames)
    judge.learn([lens] * len(frames), torch.tensor([VIGNETTING]).expand(len(frames), 3))
    expected = HeldOut(tuple(replace(f, camera=lens) for f in frames)).rays
    assert judge.rays is not None and expected is not None
    torch.testing.assert_close(judge.rays.directions, expected.directions)


# --- poses and lenses -------------------------------------------------------------------------------------------------


def off_by(pixels: float, capture: Capture) -> Capture:
    """Each training photo turned and moved at random by about so many pixels at the room's middle."""
    g = torch.Generator().manual_seed(3)
    size = pixels / CAMERA.fx / math.sqrt(2)
    moved = [turned(f.world_from_cam, *(torch.randn(2, 3, generator=g) * size)) for f in capture.frames]
    taught = {f.name for f in capture.train}
    pairs = zip(capture.frames, moved)
    return replace(capture, frames=tuple(replace(f, world_from_cam=m) if f.name in taught else f for f, m in pairs))


def apart(a: tuple[Frame, ...], b: tuple[Frame, ...]) -> Tensor:
    """How far apart two photos show the same points of the ball, pixels, (F,)."""
    points = torch.randn(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = points / points.norm(dim=-1, keepdim=True) * 0.7
    shown = [[f.camera.project(transform(invert(f.world_from_cam), points))[0] for f in one] for one in (a, b)]
    return torch.stack([(p - q).norm(dim=-1).mean() for p, q in zip(*shown)])


def test_poses_that_are_off_come_back(plain: Plain) -> None:
    given = off_by(1.5, plain.capture)
    found, psnr = fitted(given, poses=True)
    before, after = (apart(c.train, plain.capture.train) for c in (given, found.capture))
    assert after.median() < 0.5 * before.median()
    assert psnr > plain.psnr - 1.5
    assert apart(found.capture.held_out, plain.capture.held_out).max() < 0.35


def test_sound_poses_stay(plain: Plain) -> None:
    found, psnr = fitted(plain.capture, poses=True)
    assert apart(found.capture.frames, plain.capture.frames).median() < 0.4
    assert psnr > plain.psnr - 0.2


def at_points(fit: PoseFit, true: list[Frame], rays: int, g: torch.Generator) -> tuple[Tensor, Batch, Stepped]:
    """A step of a field that is a cloud of known points: its error is how far a ray passes by the point whose pixel it
    is."""
    owner = torch.randint(len(true), (rays,), generator=g)
    points = torch.randn(rays, 3, generator=g) * 0.5
    pixels = [
        true[int(o)].camera.project(transform(invert(true[int(o)].world_from_cam), p)) for o, p in zip(owner, points)
    ]
    d = torch.stack([f.camera.unproject(p[0]) for f, p in zip([fit.frames[int(o)] for o in owner], pixels)]).float()
    found = fit.rays(owner, d)
    t = (points - found.origins).norm(dim=-1, keepdim=True)
    errors = 0.1 * (found.origins + t * found.directions - points)
    to_origin = errors * (0.1 * 2 / (3 * rays))
    none = torch.zeros(0)
    batch = Batch((found.origins, found.directions, none), none, none, moving=rays)
    return owner, batch, Stepped(0.0, none, none, none, rays, errors=errors, to_rays=(to_origin, t * to_origin))


def test_poses_and_lenses_go_where_the_errors_lead() -> None:
    g = torch.Generator().manual_seed(1)
    name = Path("0.png")
    true = [Frame(name, CAMERA, f"{i}", pose) for i, pose in enumerate(poses(12))]
    lens = replace(CAMERA, fx=CAMERA.fx * 1.02, fy=CAMERA.fy * 1.02, cx=24.8, cy=23.5)
    given = [
        replace(f, camera=lens, world_from_cam=turned(f.world_from_cam, *(torch.randn(2, 3, generator=g) * 0.02)))
        for f in true
    ]
    fit = PoseFit(given, 2.0)
    for _ in range(60):
        fit.learn(*at_points(fit, true, 256, g), 1.0)
    after = apart(fit.found(), tuple(true))
    assert after.mean() < 0.35 * apart(tuple(given), tuple(true)).mean()
    now = fit.lenses()[lens]
    assert abs(now.fx - CAMERA.fx) < 0.2 * abs(lens.fx - CAMERA.fx)
    assert abs(now.cx - CAMERA.cx) < 0.3 * abs(lens.cx - CAMERA.cx)
    assert abs(now.cy - CAMERA.cy) < 0.3 * abs(lens.cy - CAMERA.cy)


def test_what_is_found_is_what_the_rays_were() -> None:
    frames = [Frame(Path("0.png"), CAMERA, f"{i}", pose) for i, pose in enumerate(poses(5))]
    fit = PoseFit(frames, 2.0)
    g = torch.Generator().manual_seed(2)
    fit.moved, fit.lens = torch.randn(5, 6, generator=g), torch.randn(1, 3, generator=g)
    fit._pose()
    d = CAMERA.unproject(CAMERA.pixel_centres()).float()
    for i, frame in enumerate(fit.found()):
        rays, expected = fit.rays(torch.full((len(d),), i), d), camera_rays(frame.camera, frame.world_from_cam)
        torch.testing.assert_close(rays.origins, expected.origins)
        torch.testing.assert_close(rays.directions, expected.directions, rtol=0, atol=1e-6)


# --- strangers --------------------------------------------------------------------------------------------------------


def test_strangers_are_not_trusted_and_not_shown(plain: Plain, tmp_path: Path) -> None:
    """A bright square passes through three of the photos."""
    spots = {3: (10, 12), 11: (25, 30), 22: (5, 30)}

    def passing(photo: Tensor, i: int) -> Tensor:
        if i in spots:
            row, column = spots[i]
            photo[row : row + 12, column : column + 12] = torch.tensor([1.0, 0.9, 0.1])
        return photo

    capture = room(tmp_path, change=passing)
    photos = Photos.of(capture)
    torch.manual_seed(0)
    run = _run(capture, photos)
    trust, bank = run.photos.trust, run.pixels
    assert trust is not None
    every = torch.arange(len(bank))
    shown = trust.trust[trust.patches(every, bank.frame_of(every))].view(-1, CAMERA.height, CAMERA.width)
    inside = torch.zeros(shown.shape, dtype=torch.bool)
    names = [f.name for f in bank.frames]
    for i, (row, column) in spots.items():
        inside[names.index(f"{i:03d}.png"), row : row + 12, column : column + 12] = True
    assert shown[inside].mean() < 0.3 and shown[~inside].mean() > 0.9
    for i, (row, column) in spots.items():
        frame = capture.frames[i]
        part = slice(row, row + 12), slice(column, column + 12)
        view, truth = render_frame(run.model, frame).rgb[part], photograph(CAMERA, frame.world_from_cam)[part]
        stranger = frame_image(frame)[part].float() / 255
        assert (view - truth).square().mean() < 0.15 * (view - stranger).square().mean()


def _run(capture: Capture, photos: Photos) -> _Fit:
    """A fit with trust that has run."""
    config = replace(TINY, steps=600, photos=PhotoModelConfig(trust=True))
    fit = _Fit(new_field(capture, config, 0), photos, config, None, None)
    fit.run()
    fit.model.eval().requires_grad_(False)
    return fit
