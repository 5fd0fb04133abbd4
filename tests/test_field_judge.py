"""What fields are judged by: known exposures, blurs and floaters are told as they are."""

from __future__ import annotations

import importlib
import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Frame
from refield.scene.errors import InputError
from refield.scene.images import read_image
from refield.scene.pose import rigid
from tests.captures import looking_at, write_capture
from tests.conftest import HERE

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def part(monkeypatch: pytest.MonkeyPatch) -> Iterator:
    """Imports a part of the judge by name."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    before = set(sys.modules)
    yield lambda name: importlib.import_module(f"fields.{name}")
    for name in set(sys.modules) - before:
        if str(BENCHMARKS) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def noise(height: int, width: int, seed: int = 0) -> Tensor:
    """Values that a photo has, without any frequency that is missing."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(height, width, 3, generator=generator)


def test_exposure_is_found_where_much_is_clipped(part) -> None:
    m = part("measures")
    render, gains = noise(60, 80), torch.tensor([1.6, 1.0, 0.55], dtype=torch.float64).log()
    photo = (m.lit(render, gains) * 255).round() / 255
    assert float((photo[..., 0] == 1).float().mean()) > 0.1
    found = m.log_gains(render, photo)
    assert found.tolist() == pytest.approx(gains.tolist(), abs=2e-3)
    # a tenth of the pixels show something else: hardly another exposure
    photo[:6] = noise(6, 80, seed=1)
    assert m.log_gains(render, photo).tolist() == pytest.approx(gains.tolist(), abs=0.05)


def test_nothing_to_tell_an_exposure_by_leaves_it(part) -> None:
    m = part("measures")
    white, black = torch.ones(20, 20, 3), torch.zeros(20, 20, 3)
    assert m.log_gains(white, white).tolist() == m.log_gains(black, noise(20, 20)).tolist() == [0.0, 0.0, 0.0]


def test_a_photo_against_itself(part) -> None:
    m = part("measures")
    photo = (noise(50, 70) * 255).round() / 255
    assert m.log_gains(photo, photo).tolist() == pytest.approx([0, 0, 0], abs=1e-9)
    assert m.decibels(m.mean_square(photo, photo)) == 100
    assert m.sharpness([photo], [photo]) == pytest.approx(1.0)
    assert m.sharpness([0.5 * photo], [photo]) == pytest.approx(0.5)


def test_error_in_decibels(part) -> None:
    m = part("measures")
    photo = torch.full((8, 8, 3), 100 / 255)
    assert m.decibels(m.mean_square(photo + 10 / 255, photo)) == pytest.approx(20 * math.log10(25.5), abs=1e-3)


def test_sharpness_of_a_blur_is_its_transfer_function(part) -> None:
    m = part("measures")
    sigma, size = 0.9, 512
    frequency = torch.fft.fftfreq(size, dtype=torch.float64)
    radius = (frequency[:, None].square() + frequency.square()).sqrt()
    transfer = (-2 * (math.pi * sigma * radius).square()).exp()
    photo = noise(size, size).double()
    render = torch.fft.ifft2(torch.fft.fft2(photo, dim=(0, 1)) * transfer[..., None], dim=(0, 1)).real
    band = (radius >= 1 / 8) & (radius < 1 / 4)
    expected = float(transfer[band].square().mean().sqrt())
    assert m.sharpness([render], [photo]) == pytest.approx(expected, rel=0.02)
    # whatever lies outside of the band says nothing
    slow = photo + torch.linspace(0, 3, size, dtype=torch.float64)[:, None]
    assert m.sharpness([slow], [photo]) == pytest.approx(1.0, abs=0.02)


def test_energies_add_up_as_pixels_do(part) -> None:
    m = part("measures")
    assert m.band_energy(noise(512, 1024)) == pytest.approx(2 * m.band_energy(noise(512, 512, 1)), rel=0.05)


def test_what_is_there_tells_how_near_things_are(part) -> None:
    f = part("floaters")
    camera = Camera(120, 90, 100.0, 100.0, 60.0, 45.0)
    pose = rigid(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    generator = torch.Generator().manual_seed(0)
    wall = torch.rand(80_000, 3, generator=generator, dtype=torch.float64)
    wall = wall * torch.tensor([12.0, 9.0, 0]) + torch.tensor([-6.0, -4.5, 4.0])
    air = torch.rand(3000, 3, generator=generator, dtype=torch.float64) * 0.05 + torch.tensor([0, 0, 1.0])
    behind = wall * torch.tensor([1.0, 1.0, -1.0])
    by = torch.arange(30).repeat(80_000)[:80_000]
    near = f.nearest(f.Points(torch.cat([wall, air, behind]), torch.cat([by, 0 * by[:3000], by])), camera, pose)
    assert near.shape == (90, 120) and bool(near.isfinite().all())
    assert float(near[45, 60]) == pytest.approx(4.0, rel=0.02)  # most points are in the air, but one photo's alone
    assert float(near[0, 0]) == pytest.approx(math.hypot(4, 0.57 * 4, 0.43 * 4), rel=0.06)
    many = f.nearest(f.Points(torch.cat([wall, air]), torch.cat([by, by[:3000]])), camera, pose)
    assert float(many[45, 60]) < 1.1  # all photos show it: it is there
    assert not bool(f.nearest(f.Points(behind, by), camera, pose).isfinite().any())
    nothing = f.Points(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.long))
    assert not bool(f.nearest(nothing, camera, pose).isfinite().any())


class Slabs:
    """A wall at y = 3 and, if so, a veil at y = 1 over the right half, of a given opacity; rays go along +y."""

    def __init__(self, veil: float) -> None:
        self.veil = veil
        self.sampler = self

    def samples(self, rays, jitter: bool = False):
        from refield.field.volrend import Samples

        edges = torch.linspace(0.5, 3.5, 31)
        n = len(rays)
        return Samples(edges[:-1].repeat(n), edges[1:].repeat(n), torch.arange(n + 1) * 30)

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        thin = (x[:, 1] > 1) & (x[:, 1] < 1.1) & (x[:, 0] > 0)
        sigma = torch.where(x[:, 1] > 3, 200.0, 0.0) + torch.where(thin, -math.log(1 - self.veil) / 0.1, 0.0)
        return sigma, torch.full((len(x), 3), 0.5)


@pytest.mark.parametrize(("veil", "share"), [(0.0, 0.0), (0.05, 0.0), (0.5, 0.5)])
def test_a_veil_before_the_camera_is_seen(part, veil: float, share: float) -> None:
    f = part("floaters")
    camera = Camera(64, 48, 200.0, 200.0, 32.0, 24.0)
    pose = looking_at(torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    frame = Frame(Path("none.png"), camera, "none.png", pose)
    u, v = torch.meshgrid(torch.linspace(-0.6, 0.6, 150), torch.linspace(-0.5, 0.5, 150), indexing="ij")
    wall = torch.stack([u, torch.full_like(u, 3.0), v], -1).reshape(-1, 3).double()
    found = f.floaters_before(Slabs(veil), frame, f.Points(wall, torch.arange(len(wall)) % 20))
    assert found.known == 1.0
    assert found.share == pytest.approx(share, abs=0.1)
    assert found.light == pytest.approx(veil / 2, abs=0.06)


def test_exposures_are_put_on_in_linear_light(part, tmp_path: Path) -> None:
    e, m = part("exposures"), part("measures")
    write_capture(tmp_path / "data", count=12)
    turned = Image.Exif()
    turned[0x0112] = 6
    (tmp_path / "bare").mkdir()
    for i in range(3):
        pixels = np.random.default_rng(i).integers(40, 120, (40, 60, 1), np.uint8).repeat(3, -1)
        Image.fromarray(pixels).resize((120, 80)).save(tmp_path / "bare" / f"{i}.jpg", quality=98, exif=turned)
    for name in ("data", "bare"):
        gains = e.put_off(tmp_path / name, tmp_path / f"{name}-off", 3)
        for photo, (r, g, b) in gains.items():
            assert 2**-0.5 <= g <= 2**0.5 and 0.95 <= r / g <= 1.05 and 0.95 <= b / g <= 1.05
            old, new = (read_image(tmp_path / f / photo).float() / 255 for f in (name, f"{name}-off"))
            assert old.shape == new.shape
            assert m.log_gains(old, new).exp().tolist() == pytest.approx([r, g, b], rel=0.03)  # of 8 bits
    assert len({tuple(g) for g in gains.values()}) == 3
    assert (tmp_path / "data-off" / "transforms.json").read_bytes() == (tmp_path / "data/transforms.json").read_bytes()
    (tmp_path / "bare" / "film.mp4").write_bytes(b"")
    with pytest.raises(InputError, match="video"):
        e.put_off(tmp_path / "bare", tmp_path / "no", 0)


def test_curves_are_read_between_looks(part) -> None:
    t = part("tell")
    looks = [{"step": s, "seconds": s / 10, "psnr": p} for s, p in ((100, 20.0), (200, 24.0), (300, 23.0))]
    assert (t.psnr_at(looks, 5), t.psnr_at(looks, 10), t.psnr_at(looks, 15)) == (None, 20.0, 22.0)
    assert (t.psnr_at(looks, 30), t.psnr_at(looks, 31)) == (23.0, None)
    assert (t.time_to(looks, 18), t.time_to(looks, 23), t.time_to(looks, 25)) == (10.0, 17.5, None)


def test_stages_are_read_from_what_the_command_says(part) -> None:
    lines = ["[   0.1 s] find where the photos were taken", "   12 of 12 placed", "[  30.1 s] fit a field to 11 photos"]
    assert part("trained").stages([*lines, "[  90.6 s] keep the field"]) == pytest.approx({"poses": 30.0, "fit": 60.5})
    assert part("trained").stages([]) == {"poses": None, "fit": None}


def test_names_say_which_capture(part, tmp_path: Path) -> None:
    name = part("run").name_of
    assert (name(tmp_path / "fox"), name(tmp_path / "fox" / "images")) == ("fox", "fox")
    assert name(tmp_path / "out" / "best" / "work" / "capture") == "best"


def test_the_script_fits_judges_and_goes_on_after_a_failure(tmp_path: Path) -> None:
    write_capture(tmp_path / "ring" / "before", count=20, camera=Camera(64, 48, 80.0, 80.0, 32.0, 24.0))
    script = [sys.executable, str(BENCHMARKS / "fields.py")]
    options = ["--train", "--fit.steps 40 --fit.check-every 20", "--out", str(tmp_path / "out")]

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*script, *arguments], env=HERE, cwd=tmp_path, capture_output=True, text=True, timeout=300
        )

    said = run(str(tmp_path / "ring" / "before"), "--exposure", "1", *options, "--json")
    assert said.returncode == 0, said.stderr
    (row,) = json.loads(said.stdout)
    assert (row["name"], row["photos"], row["left out"]) == ("ring-exposure1", 20, 2)
    assert row["no exposure fitted"] > 5 and row["heldout"] > 5 and 0 <= row["floaters"] <= 1
    assert row["poses"] is None and 0 < row["fit"] < row["whole"] and row["peak"] > 0.1 and len(row["looks"]) > 1
    folder = tmp_path / "out" / "ring-exposure1" / "default"
    with Image.open(folder / "sheet.png") as sheet:
        assert sheet.size[0] > 1000
    again = run(str(folder / "work"), "--out", str(tmp_path / "out"), "--json")
    assert json.loads(again.stdout)[0]["heldout"] == pytest.approx(row["heldout"], abs=1e-6)
    failed = run(str(tmp_path / "ring" / "before"), "--train", "--fit.nonsense 1", "--out", str(tmp_path / "out"))
    assert failed.returncode == 1 and "failed: " in failed.stdout
